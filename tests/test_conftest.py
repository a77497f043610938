"""The guards of `conftest.py` catch what they are for."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

CONFTEST = Path(__file__).with_name("conftest.py").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "body",
    [
        "import asyncio\nasync def test_leak():\n    global task\n"
        "    task = asyncio.create_task(asyncio.sleep(60))\n",
        "import multiprocessing, time\n"
        "def test_leak():\n"
        "    process = multiprocessing.get_context('fork').Process(target=time.sleep, args=(60,))\n"
        "    process.start()\n",
    ],
    ids=["task", "process"],
)
def test_what_is_left_behind_fails_the_test(pytester: pytest.Pytester, body: str) -> None:
    pytester.makeconftest(CONFTEST)
    pytester.makeini(
        "[pytest]\nasyncio_mode = auto\nasyncio_default_fixture_loop_scope = function\n"
    )
    pytester.makepyfile(body)
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-W", "ignore")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*left running*"])
