"""Who does what a refusal of `tune` says gets what was asked for; benches of the second world,
defaults, 10 Hz.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import dump_toml
from membrane_ctrl.model.errors import Exit
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump, foreign_bench, foreign_config
from tuning import twin_hold
from tuning.identification.experiments import fit_experiments, run_experiments
from tuning.rigs.hold_rig import HoldRig
from tuning.twin_hold import TwinHold


@dataclass(frozen=True)
class Refusal:
    """A bench, what is wrong with it, what is asked of it, what is said, and what is then done."""

    words: tuple[str, ...]  # of the command
    refusal_text: str
    instead: tuple[str, ...] = ()  # the words that the refusal asks for; else the same
    plant: Callable[[], ForeignPlant] = lambda: ForeignPlant(
        ForeignPump(), weather=0.3, laser_um=0.5
    )
    wrong: dict[str, float] = field(default_factory=dict)  # until the refusal is obeyed
    then: Callable[[], ForeignPlant] | None = None  # another bench than before
    code: Exit = Exit.REJECTED


def straight(**plant: float) -> Callable[[], ForeignPlant]:
    return lambda: ForeignPlant(ForeignPump(), **{"weather": 0.3, "laser_um": 0.5, **plant})  # type: ignore[arg-type]


REFUSALS = {
    "limit in the noise": Refusal(
        ("characterise", "--limit-um", "3"),
        "give a larger limit",
        ("characterise", "--limit-um", "20"),
        straight(laser_um=3.0),
        code=Exit.DEVICE_FAILED,
    ),
    "observed too briefly": Refusal(
        ("run", "--yes", "--observe", "60s"),
        "200 s at least",
        ("run", "--yes", "--observe", "200s", "--verify", "60s"),
    ),
    "stuck pump": Refusal(
        ("pump",),
        "the pump is stuck, or its gas does not arrive: free it",
        wrong={"pump_stuck_fraction": 0.31},
    ),
    "laser lost": Refusal(
        ("characterise",),
        "no valid laser reading; start or resume",
        wrong={"no_light": 1},
        code=Exit.DEVICE_FAILED,
    ),
    "too tight": Refusal(
        ("characterise",), "open the bleed", plant=straight(leak_um_per_s=0.04, weather=0.1)
    ),
    "least flow above the leak": Refusal(
        ("pump",),
        "open the bleed",
        plant=lambda: ForeignPlant(
            ForeignPump("bottom unreachable", 25.0, 0.3, 0.3), 5, 0.8, 0.6, laser_um=0.5
        ),
    ),
    "relays stopped by weather": Refusal(
        ("characterise",),
        "repeat `tune characterise` with a larger --limit-um",
        ("characterise", "--limit-um", "30"),
        straight(seed=2, weather=8.0, laser_um=3.0),
    ),
    "survey stopped by weather": Refusal(
        ("pump", "--limit-um", "30"),
        "in steadier weather",
        plant=lambda: ForeignPlant(
            ForeignPump("quadratic", 1.66, 0.07, 0.63), 2241, 1.72, 1.25, True, 2.3
        ),
        then=lambda: ForeignPlant(
            ForeignPump("quadratic", 1.66, 0.07, 0.63), 2241, 0.3, 1.25, False, 0.5
        ),
    ),
}


class Hold(TwinHold):
    """What `--twin` starts: a hold on the plant of the refusal."""

    refusal: Refusal
    obeyed = False

    def __init__(self, config: Config) -> None:
        plant = self.refusal.then if self.obeyed and self.refusal.then else self.refusal.plant
        super().__init__(config, bench=foreign_bench(plant()))
        for _ in range(0 if self.obeyed else 40):
            self.read_news()
        for name, value in ({} if self.obeyed else self.refusal.wrong).items():
            setattr(self.bench.wrong, name, value)


def obeyed(
    refusal: Refusal,
    logs: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Ask, be refused, do what the refusal says, and get it."""
    monkeypatch.setattr(twin_hold, "TwinHold", Hold)
    monkeypatch.setattr(Hold, "refusal", refusal, raising=False)
    loop = {"rate_hz": 10.0}
    config = logs / "lab.toml"

    def tuned(words: tuple[str, ...]) -> tuple[int, str]:
        config.write_text(dump_toml(foreign_config(**loop)))
        code = run(["tune", *words, "--twin", "--config", str(config), "--logs", str(logs)])
        return code, capsys.readouterr().err

    code, refusal_text = tuned(refusal.words)
    assert code == refusal.code, refusal_text
    assert refusal.refusal_text in refusal_text
    assert "Traceback" not in refusal_text
    monkeypatch.setattr(Hold, "obeyed", True)
    asked = re.search(r"loop\.bleed_fraction larger by ([\d.]+)", refusal_text)
    loop["bleed_fraction"] = float(asked[1]) if asked else 0.0
    code, refusal_text = tuned(refusal.instead or refusal.words)
    assert code == Exit.DONE, refusal_text


@pytest.mark.campaign
@pytest.mark.parametrize("name", REFUSALS)
def test_a_refusal_that_is_obeyed_is_not_given_again(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    obeyed(REFUSALS[name], tmp_path, monkeypatch, capsys)


@pytest.mark.campaign
@pytest.mark.parametrize("weather", [2.0, 4.0])
@pytest.mark.parametrize("seed", [1, 3, 5])
def test_relays_that_noise_and_weather_stop_give_the_gain(seed: int, weather: float) -> None:
    """They were discarded, and the session asked for a larger limit."""
    hold = TwinHold(
        foreign_config(rate_hz=10.0),
        bench=foreign_bench(straight(seed=seed, weather=weather, laser_um=3.0)()),
    )
    done = run_experiments(HoldRig(hold, "test"))
    found = fit_experiments(done)
    model, sigma = found.identified.model, found.identified.sigma
    assert not done.finished.completed or done.relays_s > 300.0
    assert found.quality.verdict != "refused"
    assert abs(model.gain - 1.0) < 3 * sigma.gain
    assert sigma.gain < 0.1
