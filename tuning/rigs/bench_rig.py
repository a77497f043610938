"""A bench under the tuner's control: bumpless holds and experiments on one loop."""

from typing import Protocol

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control import inner_loop, pump_curve
from membrane_ctrl.control.experiments import experiment, operating_point, trial
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from tuning.identification.record import Record
from tuning.rigs.operating_point import make_operating_point


class DrivenBench(Protocol):
    """The bench a rig drives: the twin, a fitted model, or a live hold in its `tune` state."""

    def exchange(self, pump_fraction: float, vent_fraction: float) -> experiment.BenchSample:
        """Write the commands, wait for the next tick and return its reading.

        Parameters
        ----------
        pump_fraction, vent_fraction : float
            Commands, 0..1.
        """
        ...


class Rig:
    """One loop on one bench, tick by tick.

    Parameters
    ----------
    bench : DrivenBench
        A simulated bench, or one that waits for real ticks.
    loop : LoopConfig
        Gains, rate and bleed.
    pump : PumpConfig
        Its curve turns flows into commands.
    leak_um_per_s : float
        The flow with which the loop starts.
    """

    def __init__(
        self, bench: DrivenBench, loop: LoopConfig, pump: PumpConfig, leak_um_per_s: float
    ) -> None:
        self._bench = bench
        self._config = loop
        self._pump = pump
        self._loop = inner_loop.InnerLoop(loop, pump)
        self.dt_s = 1 / loop.rate_hz
        fraction = 0.0
        if leak_um_per_s > 0:
            fraction = pump_curve.PumpCurve(pump).command(leak_um_per_s, self.dt_s)
        self._last = bench.exchange(fraction, loop.bleed_fraction)
        self._loop.start(self._last.displacement_um, leak_um_per_s)

    def set_gains(self, loop: LoopConfig) -> None:
        """Change the gains without a bump."""
        self._config = loop
        self._loop.set_gains(loop)

    def hold(self, duration_s: float, target_um: float = 0.0) -> Record:
        """Hold at a target, and return the record of the ticks.

        Parameters
        ----------
        duration_s : float
            Rounded to whole ticks.
        target_um : float
            Displacement to hold.
        """
        flows: list[float] = []
        samples: list[experiment.BenchSample] = []
        for _ in range(round(duration_s / self.dt_s)):
            out = self._loop.step(self._make_loop_input(target_um), self.dt_s)
            flows.append(out.flow_um_per_s)
            samples.append(self._last)
            self._last = self._bench.exchange(out.pump_fraction, self._config.bleed_fraction)
        return Record.from_samples(self.dt_s, flows, samples)

    def perform(self, spec: ExperimentSpec) -> tuple[Record, experiment.Finished]:
        """Run an experiment about 0 until it finishes; the loop can hold afterwards."""
        begun = trial.begin_trial(spec, self._config, self._pump, 0.0)
        return self._run_experiment(
            trial.Trial(begun, self._config.rate_hz), spec.holding_flow_um_per_s
        )

    def _run_experiment(
        self, guard: experiment.Experiment, holding_flow_um_per_s: float
    ) -> tuple[Record, experiment.Finished]:
        flows: list[float] = []
        samples: list[experiment.BenchSample] = []
        while True:
            wanted = guard.step(self._last, self.dt_s)
            if isinstance(wanted, experiment.Finished):
                self._loop.resume_at_mean(
                    self._make_loop_input(0.0), holding_flow_um_per_s, self.dt_s
                )
                return Record.from_samples(self.dt_s, flows, samples), wanted
            out = self._loop.follow_flow(self._make_loop_input(0.0), wanted, self.dt_s)
            flows.append(out.flow_um_per_s)
            samples.append(self._last)
            self._last = self._bench.exchange(out.pump_fraction, self._config.bleed_fraction)

    def around(self, held: Record, limit_um: float = 10.0) -> operating_point.OperatingPoint:
        """Operating point of an experiment.

        Parameters
        ----------
        held : Record
            The hold before it.
        limit_um : float
            How far the mirror may move from its setpoint.
        """
        return make_operating_point(held, self._config, self._pump, limit_um)

    def _make_loop_input(self, target_um: float) -> inner_loop.LoopInput:
        now = self._last
        return inner_loop.LoopInput(
            target_um, 0.0, now.displacement_um, now.ambient_pressure_pa, now.air_temperature_c
        )
