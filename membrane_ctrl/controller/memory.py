"""A controller's complete memory as bytes, so that a bit-exact replay can start in the middle of a run.

Compressed JSON (`object_codec`). A run folder may come from anywhere: every attribute is checked against today's
code, and memory of another layout is refused. It omits the run's configuration, which the folder holds.
"""

import json
import zlib
from typing import Any

from pydantic import BaseModel, ValidationError

from membrane_ctrl.config.schema import Config, PumpConfig
from membrane_ctrl.control import gas
from membrane_ctrl.control.experiments.trial import Trial
from membrane_ctrl.controller import pump_obeys, safety
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.model import object_codec, shape_estimate
from membrane_ctrl.model.telemetry import TODAY

_RULES = {rule.code: rule for rule in safety.TABLE}
_BYTES_MAX = 1 << 20  # a memory takes some 30 kB, decompressed


class UnknownMemoryError(ValueError):
    """The memory is damaged or of another layout; the message says which."""


def remember(controller: Controller) -> bytes:
    """Encode the controller's memory; empty during an experiment, which cannot be encoded."""
    try:
        plain = object_codec.encode(controller, _specials(controller._config))
    except TypeError:
        return b""
    return zlib.compress(json.dumps(plain, separators=(",", ":")).encode(), 1)


def recall(memory: bytes, fresh: Controller) -> Controller:
    """Restore a memory into `fresh`, a new controller of the same configuration. Raises UnknownMemoryError."""
    config = fresh._config
    curve = PumpConfig(curve_fraction=(0.0, 1.0), curve_um_per_s=(0.0, 1.0), flow_full_um_per_s=1.0)
    curves = (gas.branch(curve, ()), gas.branch(curve, curve.curve_um_per_s))  # either may be in force
    test = pump_obeys.ActuatorTest(config.pump, test_vent=True, rate_hz=config.loop.rate_hz)
    examples = (fresh, test, *curves)
    decoder = object_codec.Decoder(examples, _specials(config))
    try:
        expander = zlib.decompressobj()
        text = expander.decompress(memory, _BYTES_MAX)
        if not expander.eof:
            raise object_codec.CodecError("truncated or too long")
        for former, name in TODAY.items():
            text = text.replace(f'"{former}":'.encode(), f'"{name}":'.encode())
        controller = decoder.decode(json.loads(text), Controller)
    except (zlib.error, ValueError, RecursionError) as error:
        raise UnknownMemoryError(f"the recorded memory cannot be used: {error}") from None
    assert isinstance(controller, Controller)
    return controller


def _specials(config: Config) -> object_codec.Specials:
    """Types in a memory that are not encoded attribute by attribute."""
    sections = {"": config} | {name: getattr(config, name) for name in Config.model_fields}
    names = {id(section): name for name, section in sections.items()}

    def model(value: BaseModel) -> Any:
        name = names.get(id(value))
        return value.model_dump(mode="json") if name is None else name

    def model_again(data: Any, kind: type) -> Any:
        if isinstance(data, str):
            found = sections.get(data)
        else:
            assert issubclass(kind, BaseModel)
            try:
                found = kind.model_validate(data)
            except ValidationError as error:
                raise object_codec.CodecError(f"{kind.__name__}: {error.errors()[0]['msg']}") from None
        if not isinstance(found, kind):
            raise object_codec.CodecError(f"the configuration has no {kind.__name__} {str(data)[:40]!r}")
        return found

    return {
        BaseModel: object_codec.Special(model, model_again),
        safety.Rule: object_codec.Special(lambda rule: rule.code, _rule),
        shape_estimate.ShapeEstimate: object_codec.ESTIMATE,
        Trial: object_codec.Special(_no_trial, _no_trial_again),
    }


def _rule(data: Any, _: type) -> safety.Rule:
    if type(data) is not int or data not in _RULES:
        raise object_codec.CodecError(f"the safety table has no rule {str(data)[:40]!r}")
    return _RULES[data]


def _no_trial(_: Trial) -> Any:
    raise TypeError("an experiment cannot be encoded")


def _no_trial_again(_: Any, __: type) -> Any:
    raise object_codec.CodecError("an experiment cannot be continued")
