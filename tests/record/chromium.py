"""A browser without a screen, driven by what Chromium speaks on two pipes; needs nothing but Chromium itself."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import time

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


def find() -> str:
    """The browser's path; without one the test is skipped."""
    found = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium)")
    return found


class Page:
    """A page opened at ``address``."""

    def __init__(self, address, folder, size=(1200, 800)):
        to_browser, commands = os.pipe()
        answers, from_browser = os.pipe()

        def pipes():
            # Chromium reads 3 and writes 4; by way of high numbers, since these may be among the four.
            os.dup2(to_browser, 100)
            os.dup2(from_browser, 101)
            os.dup2(100, 3)
            os.dup2(101, 4)

        flags = ["--headless=new", "--no-sandbox", "--remote-debugging-pipe", "--use-angle=swiftshader"]
        flags += ["--enable-unsafe-swiftshader", "--disable-dev-shm-usage", "--no-first-run", "--no-proxy-server"]
        flags += [f"--user-data-dir={folder}/browser", f"--window-size={size[0]},{size[1]}"]
        self.browser = subprocess.Popen(
            [find(), *flags, "about:blank"],
            preexec_fn=pipes,
            close_fds=False,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        self.commands, self.answers, self.waiting, self.number, self.session = commands, answers, b"", 0, None
        target = self.do("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.do("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.do("Page.navigate", url=address)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.browser.kill()
        self.browser.wait()
        os.close(self.commands)
        os.close(self.answers)

    def do(self, method, seconds=120.0, **parameters):
        """Do one command of the DevTools protocol."""
        self.number += 1
        command = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            command["sessionId"] = self.session
        os.write(self.commands, json.dumps(command).encode() + b"\0")
        deadline = time.monotonic() + seconds
        while True:
            while b"\0" in self.waiting:
                line, _, self.waiting = self.waiting.partition(b"\0")
                answer = json.loads(line)
                if answer.get("id") == self.number:
                    assert "error" not in answer, answer
                    return answer["result"]
            assert select.select([self.answers], [], [], max(0, deadline - time.monotonic()))[0], f"{method}: no answer"
            self.waiting += os.read(self.answers, 1 << 20)

    def value(self, expression):
        """What a JavaScript expression gives."""
        return self.do("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait_for(self, expression, value, seconds=240.0):
        """Wait until an expression gives ``value``."""
        deadline = time.monotonic() + seconds
        while (found := self.value(expression)) != value:
            assert time.monotonic() < deadline, f"{expression} is {found!r}, not {value!r}"
            time.sleep(0.2)

    def picture(self):
        """A PNG of what is shown."""
        return base64.b64decode(self.do("Page.captureScreenshot", format="png")["data"])
