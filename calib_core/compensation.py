"""A fitted model turned round: what rate an output means, and the model as parameters, names and JSON.

Sensors answer late and know nothing of it, so not everything can be undone sample by sample: the rate that comes out
belongs to a moment ``delay_s`` before the sample. What belongs to the encoder, or cannot be foretold, is left out and
named. ``compensation_c`` and ``compensation_python`` write the same arithmetic.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core.covariates import TURNING_DPS
from calib_core.effects import Acts, Covariates, Effect, library
from calib_core.formula import UserEffect, from_json, to_json
from calib_core.integral_fit import SUFFIX
from calib_core.model import Model
from calib_core.problem import Problem

F64 = NDArray[np.float64]

FORMAT = "gyro-compensation 1"
OWN_WAY = {"bandwidth_lag", "angular_acceleration", "dead_band", "time_offset", "input_loading", "saturation"}
"""Undone otherwise than by subtracting a formula."""
TOLD = {"time_offset", "saturation"}
"""Told beside the rate: the rate's age, and whether the output is at a limit."""
UNFORETOLD = {"mains_hum": "phase", "bias_random_walk": "random", "adc_quantization": "rounding", "clock_skew": "clock"}
TURNS, CLOSE_DPS = 30, 1e-9
"""Effects that depend on the rate are taken out by turns, until the rate changes by less than this."""
SWAYING_DPS, FASTEST_DPS = 1.0, 1e5
"""Where a formula jumps, turns may sway about the jump; what sways further, or runs further away, is no rate."""

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Compensation:
    """One axis' model, ready to be turned round. Times count as in the recording that it was fitted to."""

    axis: str
    model: Model
    rows: tuple[Row, ...]
    """Parameters as CONTRACT 3 names them: name, value, unit, standard_uncertainty."""
    reference: Mapping[str, float] = field(default_factory=dict)
    """Where temperature and supply count from (``temperature_c``, ``supply_v``)."""
    board: str = ""
    source: Mapping[str, object] = field(default_factory=dict)
    """Where the model comes from, for people: recording, software."""
    turning_dps: float = TURNING_DPS
    """Rates beyond this give the direction of the last rotation; within it a dead band feels nothing."""

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Those that are undone, or told beside the rate."""
        return tuple(e for e in self.model.effects if _reason(e) is None)

    @property
    def left_out(self) -> tuple[tuple[str, str], ...]:
        """Effects of the model that are not undone, and the last word of the text that says why."""
        return tuple((e.name, reason) for e in self.model.effects if (reason := _reason(e)) is not None)

    @property
    def undone(self) -> tuple[str, ...]:
        """Names of the effects that the rate is free of."""
        return tuple(e.name for e in self.effects if e.name not in TOLD)

    @property
    def delay_s(self) -> float:
        """So much before its sample's time stamp the rate was felt, beside half a sampling interval for a lag."""
        return self.value("time_offset", "delay")

    @property
    def halved(self) -> bool:
        """Whether the rate is the mean since the last sample, so half an interval older: a lag undone gives that."""
        return any(e.name == "bandwidth_lag" for e in self.effects)

    def value(self, effect: str, parameter: str) -> float:
        """A parameter of an effect that is undone; 0 without that effect."""
        return next((e.values[parameter] for e in self.effects if e.name == effect), 0.0)

    @classmethod
    def of(
        cls,
        rows: Sequence[Row],
        *,
        axis: str,
        unit: str,
        reference: Mapping[str, float],
        user_effects: Sequence[Mapping[str, object]] = (),
        **more: Any,
    ) -> "Compensation":
        """From parameters under CONTRACT 3's names. Raises Problem ``compensation.…``.

        A sensor that tells deg/s and whose scale factor the record did not show counts as scaled right.
        """
        own = {effect.name: effect for effect in map(from_json, user_effects)}
        known: dict[str, type[Effect]] = {**library(), **own}
        suffix = SUFFIX.get(unit)
        bias: float | None = None
        scale_factor = 1.0 if unit == "deg/s" else None
        values: dict[str, dict[str, float]] = {}
        for row in rows:
            name, value = str(row.get("name")), row.get("value")
            if not isinstance(value, int | float) or not np.isfinite(value):
                raise Problem("compensation.no_value", name=name)
            effect, _, parameter = name.partition(".")
            if name == f"bias_{suffix}":
                bias = float(value)
            elif name == f"scale_factor_{suffix}_per_dps":
                scale_factor = float(value)
            elif effect not in known:
                raise Problem("compensation.unknown_parameter", name=name)
            elif parameter in known[effect].parameters():
                values.setdefault(effect, {})[parameter] = float(value)
            elif _class_reason(known[effect]) is None:
                raise Problem("compensation.unknown_parameter", name=name)
            else:
                values.setdefault(effect, {})
        if bias is None or not scale_factor:
            raise Problem("compensation.no_base", axis=axis, unit=unit)
        # In the order of the signal chain: the sensor's lag is behind whatever else it does to the rate.
        effects = sorted((known[n](**v) for n, v in values.items()), key=lambda e: e.name == "bandwidth_lag")
        model = Model(bias, scale_factor, unit, effects=tuple(effects))
        for effect_ in effects:
            for need in effect_.needs:
                if need in ("temperature_c", "supply_v") and need not in reference and _counts_from(effect_):
                    raise Problem("compensation.no_reference", effect=effect_.name, column=need)
        return cls(axis, model, tuple(rows), dict(reference), **more)

    @classmethod
    def of_diagnosis(cls, answer: Mapping[str, Any], *, as_asked: bool = False) -> "Compensation":
        """From CONTRACT 3's JSON: the model with what was missing, or ``as_asked`` the model as it was given."""
        model = answer.get("model" if as_asked else "after")
        if not isinstance(model, Mapping) or not model.get("parameters"):
            why = {"code": answer.get("code", ""), "values": answer.get("values", {})}
            raise Problem("compensation.no_model", axis=answer.get("axis"), reason=why)
        rows = list(model["parameters"])
        if not as_asked:
            there = {row["name"] for row in rows}
            found = [row for finding in answer["missing"] for row in finding["parameters"]]
            rows += [row for row in found if row["name"] not in there]
        recording = answer["recording"]
        return cls.of(
            rows,
            axis=answer["axis"],
            unit=answer["unit"],
            reference=answer["model"].get("reference", {}),
            user_effects=answer.get("user_effects", ()),
            board=recording.get("board") or "",
            source={key: recording[key] for key in ("file", "digest") if recording.get(key)},
        )

    def to_json(self) -> dict[str, Any]:
        """What ``from_json`` makes the same compensation of; numbers keep all their digits."""
        return {
            "format": FORMAT,
            "board": self.board,
            "axis": self.axis,
            "unit": self.model.unit,
            "effects": [e.name for e in self.model.effects],
            "parameters": [dict(row) for row in self.rows],
            "reference": dict(self.reference),
            "turning_dps": self.turning_dps,
            "delay_s": self.delay_s,
            "rate_is_mean_since_last_sample": self.halved,
            "left_out": [{"effect": name, "reason": reason} for name, reason in self.left_out],
            "user_effects": [to_json(type(e)) for e in self.model.effects if isinstance(e, UserEffect)],
            "source": dict(self.source),
        }

    @classmethod
    def from_json(cls, saved: bytes | str | Mapping[str, Any]) -> "Compensation":
        """From ``to_json``'s answer or its text. Raises Problem ``compensation.not_json`` and those of ``of``."""
        try:
            tree = json.loads(saved) if isinstance(saved, bytes | str) else saved
            if tree["format"] != FORMAT:
                raise Problem("compensation.not_json", format=FORMAT)
            reference = {key: float(value) for key, value in tree["reference"].items()}
            more = {"board": str(tree["board"]), "source": tree["source"], "turning_dps": float(tree["turning_dps"])}
            parts = tree["parameters"], str(tree["axis"]), str(tree["unit"]), tree["user_effects"]
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            if isinstance(error, Problem):
                raise
            raise Problem("compensation.not_json", format=FORMAT) from None
        return cls.of(parts[0], axis=parts[1], unit=parts[2], reference=reference, user_effects=parts[3], **more)

    def rate(self, output: F64, covariates: Covariates) -> F64:
        """(n,) deg/s that ``output`` (n,) means, nan where the model has no rate for it.

        Of ``covariates``, rate, acceleration and direction are not used: they are what is sought.
        """
        c = replace(covariates, reference=self.reference, memory={})
        level = self._before_converter(np.asarray(output, float))
        on_output, on_rate = self._acting(Acts.OUTPUT), self._acting(Acts.RATE)
        rate = (level - self.model.bias) / self.model.scale_factor
        before = rate
        for _ in range(TURNS):
            c = replace(c, rate_dps=rate, direction=self._direction(rate), memory={})
            felt = (level - self.model.bias - _sum(on_output, c)) / self.model.scale_factor
            following = self._turned_back(self._before_lag(felt, c.interval_s) - _sum(on_rate, c), c.interval_s)
            before, rate = rate, np.clip(following, -FASTEST_DPS, FASTEST_DPS)
            if np.abs(rate - before).max() < CLOSE_DPS:
                break
        settled = (np.abs(rate - before) < SWAYING_DPS) & (np.abs(rate) < FASTEST_DPS)
        return np.where(settled, (rate + before) / 2.0, np.nan)

    def _acting(self, acts: Acts) -> list[Effect]:
        return [e for e in self.effects if e.acts is acts and e.name not in OWN_WAY]

    def _before_converter(self, output: F64) -> F64:
        loss = self.value("input_loading", "loss")
        return (output - loss * self.value("input_loading", "V_input")) / (1.0 - loss) if loss else output

    def _before_lag(self, felt: F64, interval_s: float) -> F64:
        """The mean rate since the last sample, exactly, from a first-order lag's answer."""
        tau = self.value("bandwidth_lag", "tau")
        if tau <= 0.0:
            return felt
        keep = np.exp(-interval_s / tau)
        return np.asarray((felt - keep * np.append(felt[0], felt[:-1])) / (1.0 - keep))

    def _turned_back(self, felt: F64, interval_s: float) -> F64:
        """Without dead band, then without the feeling for angular acceleration.

        u = ω + k·ω' is a filter of one pole and solved exactly for k > 0; for k < 0 that pole is unstable, and to first
        order ω = u - k·u'.
        """
        from scipy.signal import lfilter

        band = self.value("dead_band", "d")
        if band > 0.0:
            felt = np.where(np.abs(felt) > self.turning_dps, felt + np.copysign(band, felt), 0.0)
        share = self.value("angular_acceleration", "k") / interval_s
        if share < 0.0:
            return felt - share * np.diff(felt, prepend=felt[0])
        if share > 0.0:
            keep = share / (1.0 + share)
            return np.asarray(lfilter([1.0 - keep], [1.0, -keep], felt, zi=np.array([keep * felt[0]]))[0])
        return felt

    def _direction(self, rate: F64) -> F64:
        """(n,) sign of the last rate beyond ``turning_dps``; 0 before the first."""
        turned = np.flatnonzero(np.abs(rate) > self.turning_dps)
        last = np.searchsorted(turned, np.arange(len(rate)), side="right") - 1
        return np.where(last >= 0, np.sign(rate[turned[last]]), 0.0) if len(turned) else np.zeros_like(rate)


def _sum(effects: Sequence[Effect], c: Covariates) -> F64:
    total = np.zeros_like(c.rate_dps)
    for effect in effects:
        shapes = effect.columns(c, **{name: effect.values[name] for name in effect.nonlinear()})
        for name, shape in shapes.items():
            total += effect.values.get(name, 1.0) * shape
    return total


def _class_reason(effect: type[Effect]) -> str | None:
    """Why an effect is not undone; None where it is."""
    if effect.acts is Acts.ANGLE:
        return "encoder"
    if issubclass(effect, UserEffect) and "acceleration_dps2" in effect.formula.names:
        return "acceleration"
    if effect.name in UNFORETOLD:
        return UNFORETOLD[effect.name]
    written = all(p.code for name, p in effect.parameters().items() if not p.grid)
    return None if written or effect.name in OWN_WAY else "unwritten"


def _reason(effect: Effect) -> str | None:
    return _class_reason(type(effect))


def _counts_from(effect: Effect) -> bool:
    return any("warmth" in p.code or "reference_" in p.code for p in effect.parameters().values())
