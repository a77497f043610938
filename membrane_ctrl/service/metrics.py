"""All holds of a service for Prometheus, with the names of the telemetry columns."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from membrane_ctrl.model import telemetry
from membrane_ctrl.model.columns import COLUMNS
from membrane_ctrl.service.hold_seen import HoldSeen

METRICS_TYPE = CONTENT_TYPE_LATEST
# columns that only grow, as Prometheus names counters
_COUNTERS = {"tick": "ticks_total", "missed_ticks": "missed_ticks_total"}
_LABELS = ("hold",)


class _HoldCollector(Collector):
    """Makes the metrics of one moment."""

    def __init__(self, holds: Mapping[str, HoldSeen]) -> None:
        self._holds = holds

    def collect(self) -> Iterator[Metric]:
        """Yield each metric with a sample for each hold that is in contact."""
        up = GaugeMetricFamily("membrane_hold_up", "1: a hold runs and answers", labels=_LABELS)
        for name, seen in self._holds.items():
            up.add_metric([name], float(not seen.silent))
        yield up
        # Further metrics are of holds that answer: state, locks, recording.
        known = {name: seen.status for name, seen in self._holds.items() if not seen.silent}
        states = GaugeMetricFamily(
            "membrane_in_state", "1: the hold is in this state", labels=("hold", "state")
        )
        locks = GaugeMetricFamily("membrane_locks", "locks that are set", labels=_LABELS)
        recording = GaugeMetricFamily(
            "membrane_recording_ok", "0: disk or recorder have failed", labels=_LABELS
        )
        for name, status in known.items():
            for state in telemetry.State:
                word = state.name.lower()
                states.add_metric([name, word], float(status.get("state") == word))
            locks.add_metric([name], float(len(status.get("locks") or ())))
            recording.add_metric([name], float(bool(status.get("recording_ok", True))))
        yield from (states, locks, recording)
        # One metric for each telemetry column.
        for column in COLUMNS.values():
            about = f"{column.title}: {column.description}"
            family = CounterMetricFamily if column.name in _COUNTERS else GaugeMetricFamily
            metric = family(f"membrane_{metric_name(column.name)}", about, labels=_LABELS)
            for name, status in known.items():
                value = (status.get("row") or {}).get(column.name)
                metric.add_metric([name], math.nan if value is None else float(value))
            yield metric


def metric_name(column: str) -> str:
    """Return how the metric of a telemetry column is called, without the prefix `membrane_`."""
    return _COUNTERS.get(column, column)


def render_metrics(holds: Mapping[str, HoldSeen]) -> bytes:
    """Return the metrics of holds by name, in the text format of Prometheus."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_HoldCollector(holds))
    return generate_latest(registry)
