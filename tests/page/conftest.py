"""A real browser for the tests of the page: Debian's chromium, by its path."""

import pytest
from playwright.sync_api import sync_playwright


def pytest_addoption(parser):
    parser.addoption("--chromium", default="/usr/bin/chromium", help="path of the browser")
    parser.addoption("--screenshots", default="", help="folder into which screenshots for the documentation are put")


@pytest.fixture(scope="session")
def chromium(request):
    path = request.config.getoption("--chromium")
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=path, args=["--no-sandbox", "--force-color-profile=srgb"])
        yield browser
        browser.close()
