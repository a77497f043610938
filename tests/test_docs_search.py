"""The search of the documentation works in pages that are opened from the disk."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.browser import browser_tab
from tests.support.machine_needs import needs

ROOT = Path(__file__).parents[1]
# Typed again until the page listens; the value is the number of results.
_SEARCH_FOR_WATCHDOG = """(() => {
  const query = document.querySelector('[data-md-component=search-query]');
  query.focus();
  query.value = 'watchdog';
  query.dispatchEvent(new KeyboardEvent('keyup', {bubbles: true}));
  return document.querySelectorAll('.md-search-result__item').length;
})()"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """The documentation as `make lint` builds it."""
    site = tmp_path / "site"
    build = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(site)]
    subprocess.run(build, cwd=ROOT, check=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    return site


@pytest.mark.campaign
@needs("chromium")
async def test_a_page_from_the_disk_finds_a_word(site: Path, tmp_path: Path) -> None:
    async with browser_tab((site / "index.html").as_uri(), tmp_path / "profile") as tab:
        assert await tab.until(_SEARCH_FOR_WATCHDOG) > 5
