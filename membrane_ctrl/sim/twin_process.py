"""The twin as a process beside the hold: its start, its port, and its truth for the record."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace

from firmware_iface import settings
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.model import errors, terminal
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.processes import child, event_pipe, ring
from membrane_ctrl.sim.bench import BenchReport, BenchSpec
from membrane_ctrl.sim.truth import TRUTH_BYTES, Truth

_TRUTHS_KEPT = 64
_READY_S = 60.0  # importing on a busy machine; a fresh one compiles first


def start_bench(spec: BenchSpec, stack: contextlib.ExitStack) -> BenchReport:
    """Start the bench's process, wait until it listens, and print its address.

    Parameters
    ----------
    spec : BenchSpec
        Its plant, clock and port.
    stack : ExitStack
        Ends the process when it closes.

    Returns
    -------
    BenchReport
        Where the bench listens.

    Raises
    ------
    DeviceError
        It does not start in time, or the port is taken.
    """
    terminal.print_progress(f"starting the twin: waiting until it listens, at most {_READY_S:g} s")
    ours, theirs = event_pipe.make_pipe()
    process = child.Child("twin", "membrane_ctrl.sim.bench:serve_bench", (spec, theirs), nice=0)
    stack.callback(process.stop, 2.0)
    process.start()
    report: BenchReport = (
        ours.recv() if ours.poll(_READY_S) else BenchReport(error="the twin did not start")
    )
    if report.error:
        raise errors.DeviceError(report.error)
    if spec.lab is None:
        moved = ""
        if spec.port not in (0, report.port):
            moved = f" (port {spec.port} is taken)"
        terminal.print_progress(f"the twin listens on {report.url}{moved}, Modbus unit 1")
    return report


def bench_spec(config: Config, clock: RunClock) -> BenchSpec:
    """Return what the bench's process needs of a configuration.

    Parameters
    ----------
    config : Config
        Tables `twin` and `pump`. If the default port is taken, another twin may have it, and a free
        one serves; a port that the configuration states is required.
    clock : RunClock
        The run's clock, on which the plant runs.
    """
    twin = config.twin
    return BenchSpec(
        twin, config.pump, clock, twin.port, only_there="port" in twin.model_fields_set
    )


@dataclass(frozen=True, slots=True)
class TwinProcess:
    """A running simulated bench."""

    config: Config  # the run's configuration with the twin's own address as its device
    truth: ring.RingAddress  # where the twin publishes its mirror's true state

    @classmethod
    def start_twin(
        cls, config: Config, clock: RunClock, stack: contextlib.ExitStack, lab: bool = False
    ) -> "TwinProcess":
        """Start the twin and wait until it listens.

        Parameters
        ----------
        config : Config
            The run's configuration.
        clock : RunClock
            The run's clock, on which the plant runs.
        stack : ExitStack
            Ends the twin when it closes.
        lab : bool
            Whether the twin answers as the configured instruments instead of the pump board.

        Raises
        ------
        DeviceError
            It does not start, e.g. because the port is taken.
        InputError
            More interlocks are configured than the pump board has inputs.
        """
        if len(config.interlocks) > settings.BOARD_INPUTS and not lab:
            raise errors.InputError(
                f"devices.interlocks: {len(config.interlocks)} of them; the twin's pump board has "
                f"{settings.BOARD_INPUTS} inputs: use --devices, or fewer"
            )
        truth = stack.enter_context(ring.open_ring(_TRUTHS_KEPT, TRUTH_BYTES))
        spec = replace(bench_spec(config, clock), truth=truth, lab=config.devices if lab else None)
        report = start_bench(spec, stack)
        watchdog = {}
        if config.devices is not None:
            watchdog = config.devices.model_dump(include={"timeout_s", "watchdog_s"})
        devices = report.lab or DevicesConfig(
            board=report.url, interlocks=_at_board_inputs(config.interlocks), **watchdog
        )
        return cls(config.model_copy(update={"devices": devices}), truth)

    def truth_reader(self) -> Callable[[], tuple[float, float]]:
        """A function that returns the newest true displacement and laser bias, in µm."""
        reader = ring.RingReader(self.truth)

        def newest() -> tuple[float, float]:
            message = reader.latest()
            if message is None:
                return float("nan"), float("nan")
            truth = Truth.unpack(message)
            return truth.displacement_um, truth.laser_bias_um

        return newest


def _at_board_inputs(
    interlocks: tuple[settings.InterlockDriver, ...],
) -> tuple[settings.InterlockDriver, ...]:
    """The interlocks with the inputs of the twin's board in place of their sources, in order."""
    return tuple(
        settings.BoardInputConfig(
            driver="board_input",
            name=interlock.name,
            text=interlock.text,
            safe_level=interlock.safe_level,
            input=index,
        )
        for index, interlock in enumerate(interlocks)
    )
