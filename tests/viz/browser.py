# SPDX-License-Identifier: BSD-3-Clause
"""A page in a headless Chromium (Qt's): what scripts say of it, and what it looks like.

    python tests/viz/browser.py URL FOLDER SCRIPT ...

Each script is asked until its answer is true; then FOLDER/N.png shows the page, once its scene has
become another than in the picture before and has settled.
Writes JSON: the answers, and what the console called an error. A program of its own: Qt wants the
main thread, and ends as it likes.
"""

import json
import os
import sys
import time
from pathlib import Path

os.environ["QT_QPA_PLATFORM"] = "offscreen"
os.environ["QTWEBENGINE_DISABLE_SANDBOX"] = "1"  # root may not have one; the page is ours
os.environ["QTWEBENGINE_CHROMIUM_FLAGS"] = "--ignore-gpu-blocklist"  # WebGL without a GPU

from PyQt6.QtCore import QUrl
from PyQt6.QtWebEngineCore import QWebEnginePage
from PyQt6.QtWebEngineWidgets import QWebEngineView
from PyQt6.QtWidgets import QApplication

_PATIENCE = 60.0  # seconds, for everything
_STILL = 1.0  # between two pictures that must be the same
_SCENE = 900  # pixels from the left; then come the controls


class _Page(QWebEnginePage):
    errors: list[str] = []  # noqa: RUF012

    def javaScriptConsoleMessage(self, level, message, line, source):
        if level == QWebEnginePage.JavaScriptConsoleMessageLevel.ErrorMessageLevel:
            self.errors.append(f"{source}:{line}: {message}")


def browse(url, folder, scripts):
    """Return the answers to the scripts and the console's errors; write the pictures."""
    app, view, ends = QApplication(sys.argv[:1]), QWebEngineView(), time.monotonic() + _PATIENCE
    page = _Page(view)
    view.setPage(page)
    view.resize(1280, 800)
    view.show()
    view.load(QUrl(url))

    def work(what, seconds, done=lambda: False):
        until = time.monotonic() + seconds
        while not done() and time.monotonic() < until:
            app.processEvents()
            time.sleep(0.01)
            if time.monotonic() > ends:
                sys.exit(f"not within {_PATIENCE:g} s: {what}; console: {page.errors}")

    def scene():
        return view.grab().toImage().copy(0, 0, _SCENE, view.height())

    answers, last = [], scene()
    for number, script in enumerate(scripts):
        said = [None]
        while not said[-1]:
            count = len(said)
            page.runJavaScript(script, said.append)
            work(script, _PATIENCE, lambda said=said, count=count: len(said) > count)
        answers.append(said[-1])
        before, now = last, scene()
        while now == last:
            work(f"another scene after {script}", _STILL)
            now = scene()
        while now != before:
            work(f"a scene that keeps still after {script}", _STILL)
            before, now = now, scene()
        last = now
        view.grab().save(str(folder / f"{number}.png"))
    return {"answers": answers, "errors": page.errors}


if __name__ == "__main__":
    json.dump(browse(sys.argv[1], Path(sys.argv[2]), sys.argv[3:]), sys.stdout)
