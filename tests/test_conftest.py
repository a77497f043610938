"""The guards of `conftest.py` catch what they are for."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support import file_order

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


CASES = """
import pytest

@pytest.mark.fast_cases("one", {name!r})
@pytest.mark.parametrize("number", [1, 2, 3], ids=["one", "two", "three [3]"])
def test_number(number):
    pass
"""


@pytest.mark.parametrize(
    ("choice", "passed"), [("not campaign", 2), ("campaign", 1)], ids=["fast", "campaign"]
)
def test_cases_that_are_not_named_belong_to_the_campaign(
    pytester: pytest.Pytester, choice: str, passed: int
) -> None:
    pytester.makeconftest(CONFTEST)
    pytester.makepyfile(CASES.format(name="three [3]"))
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-W", "ignore", "-m", choice)
    result.assert_outcomes(passed=passed, deselected=3 - passed)


def test_a_named_case_that_does_not_exist_is_refused(pytester: pytest.Pytester) -> None:
    pytester.makeconftest(CONFTEST)
    pytester.makepyfile(CASES.format(name="four"))
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-W", "ignore")
    result.stderr.fnmatch_lines(["*names what is no case*four*"])


def test_the_longest_files_are_there() -> None:
    names = file_order.LONGEST_FIRST
    assert [name for name in names if not (file_order.ROOT / "tests" / name).is_file()] == []
    assert len(set(names)) == len(names)
