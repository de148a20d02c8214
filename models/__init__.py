"""The tactile image, the networks that judge it, and the contracts of their files."""

import os

# From 1.29 on onnxruntime keeps a telemetry database in the home folder, with a thread for it. This
# turns it off, and must run before onnxruntime is imported.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
