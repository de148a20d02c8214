"""Makes `deploy/watch.png`: `python -m tests.daemon.watch.picture`, which takes six minutes.

It runs the demo scene and `graspd watch --web` for five minutes, waits for a grasp that is `stable`
and supported by outcomes of lifts, and takes a picture of 1280 x 860 pixels.
"""

from __future__ import annotations

import base64
import contextlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.daemon.processes import GRASPD, put_first
from tests.daemon.watch.browser import Browser

ROOT = Path(__file__).parents[3]
SCENE, PICTURE = ROOT / "deploy" / "scenes" / "demo.toml", ROOT / "deploy" / "watch.png"
WIDTH, HEIGHT = 1280, 860
HISTORY_S, GRASP_S = 300.0, 120.0
"""Length of the timeline, and longest wait for a `stable` grasp after it, s."""
SOLID = "document.querySelector('.banner').dataset.tone == 'stable'"


def main(picture: Path = PICTURE) -> None:
    """Take the picture and write it to `picture`."""
    with contextlib.ExitStack() as stack:
        profile = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for words in (["run"], ["watch", "--web"]):
            process = subprocess.Popen([*GRASPD, *words, str(SCENE)], stdout=subprocess.DEVNULL)
            put_first(process.pid)
            stack.callback(process.wait)
            stack.callback(process.terminate)
        time.sleep(HISTORY_S)
        browser = stack.enter_context(Browser(profile))
        stack.enter_context(browser.blank())
        browser.look(WIDTH, HEIGHT)
        browser.go("http://127.0.0.1:8377/")
        image = ""
        while not image or not browser.value(SOLID):  # it may be let go meanwhile
            browser.wait_for(SOLID, GRASP_S)
            image = browser.ask("Page.captureScreenshot", format="png")["data"]
        picture.write_bytes(base64.b64decode(image))
    sys.stdout.write(f"{picture}\n")


if __name__ == "__main__":
    main()
