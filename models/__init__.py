"""What the tactile image is, which networks judge it, and what they state about themselves."""

import os

# From 1.29 on onnxruntime keeps a telemetry database in the home folder, and a thread for it,
# unless this says no before anybody imports it. A robot's PC tells nobody what it does.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
