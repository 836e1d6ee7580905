"""The documentation site, built once, and a browser that opens it."""

import importlib.util
import os
import shutil
import subprocess
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent

#: Seconds after which the site is not built any more, far above the minute of processor time that it takes.
BUILDING = 1500

#: What the site is built with.
NEEDED = ("sphinx", "myst_nb", "furo", "sphinx_copybutton")


class Quiet(SimpleHTTPRequestHandler):
    """Serves files without a line for each on standard error."""

    def log_message(self, *args):
        pass


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """The folder of the site: that in the variable SITE, or one that is built here with warnings as errors."""
    if built := os.environ.get("SITE"):
        return Path(built).resolve()
    if missing := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
        pytest.skip(f"the site cannot be built without {', '.join(missing)}: install the extra docs")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-n", "docs", str(folder)]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=BUILDING)
    assert process.returncode == 0, process.stderr
    return folder


@pytest.fixture(scope="session")
def address(site):
    """The address at which the site is served."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(site))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """Chromium without a window, driven by selenium."""
    pytest.importorskip("selenium", reason="no selenium to drive a browser: install the extra docs")
    from selenium import webdriver

    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no browser: chromium and chromedriver are not on the PATH")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for switch in ("gpu", "quic", "dev-shm-usage", "background-networking", "component-update", "sync"):
        options.add_argument(f"--disable-{switch}")
    for switch in ("headless", "no-sandbox", "no-first-run", f"user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(f"--{switch}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options, webdriver.ChromeService(driver))
    browser.set_page_load_timeout(300)  # on the busiest machine
    browser.set_script_timeout(300)
    yield browser
    browser.quit()
