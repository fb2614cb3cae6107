"""A diagnosis as CONTRACT 3's JSON: numbers, codes and values; the sentences are added where a language is known."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core.effects import Acts, Covariates
from calib_core.gap import Diagnosis, on_grid, p_value
from calib_core.gap_error import Explanation
from calib_core.gap_search import equivalent_z
from calib_core.integral_fit import SUFFIX

F64 = NDArray[np.float64]

FAILING = 4.0
"""|z| from which a stretch is said to fail."""


def to_json(d: Diagnosis) -> dict[str, Any]:
    """CONTRACT 3, without the rendered sentences."""
    recording, axis = d.recording, d.axis
    gyro = recording.gyro(axis) if axis in recording.axes else None
    out: dict[str, Any] = {
        "recording": {
            "file": None,
            "board": recording.header.get("board"),
            "samples": int(np.isfinite(gyro.values).sum()) if gyro else 0,
            "duration_s": recording.duration_s,
        },
        "axis": axis,
        "unit": gyro.unit if gyro else None,
        "verdict": d.verdict,
        "checks": [{"name": c.name, "ok": c.ok, "code": c.code, "values": dict(c.values)} for c in d.checks],
        "model": {"effects": [t.name for t in d.asked], "parameters": []},
        "noise": None,
        "error": None,
        "where_it_fails": [],
        "missing": [],
        "rivals": [],
        "rival_sets": [],
        "candidates": d.candidates,
        "unknown": None,
        "next_experiment": None,
        "after": None,
        "reach": None,
    }
    if d.search is None or d.before is None or d.after is None:
        failed = next((c for c in d.checks if c.blocking and not c.ok), None)
        code, values = (failed.code, dict(failed.values)) if failed else ("diagnosis.not_testable", {})
        return out | {"code": code, "values": values}
    space = d.search.space
    noise, scale = space.noise.noise, abs(space.scale_factor) or 1.0
    error, after = d.before.error(), d.after.error()
    missing = _missing(d)
    out |= {
        "noise": {
            "white_dps": noise.white / scale,
            "ar1_dps": noise.ar1 / scale,
            "correlation_time_s": noise.correlation_time_s if noise.ar1 > 0.0 else None,
        },
        "error": {
            "held_out_rms_dps": error.held_out_rms_dps,
            "floor_rms_dps": error.floor_rms_dps,
            "holdout": {"block_s": error.block_s, "blocks": error.blocks},
        },
        "where_it_fails": [
            {"covariate": f.covariate, "from": f.low, "to": f.high, "residual_dps": f.residual_dps, "z": f.z}
            for f in d.before.failures()
            if abs(f.z) >= FAILING
        ],
        "missing": missing,
        **_ties(d),
        "after": {
            "effects": [*(t.name for t in d.asked), *(m["effect"] for m in missing)],
            "held_out_rms_dps": after.held_out_rms_dps,
            "floor_rms_dps": after.floor_rms_dps,
            "parameters": parameters(d.after),
        },
        "reach": reach(space.covariates),
    }
    out["model"] |= {"parameters": parameters(d.before), "reference": dict(space.covariates.reference)}
    if d.unknown is not None:
        out["unknown"] = {"covariate": d.unknown.covariate, "p": p_value(d.unknown.z)}
    values = {
        "effects": [m["effect"] for m in missing],
        "before_dps": error.held_out_rms_dps,
        "after_dps": after.held_out_rms_dps,
        "floor_dps": after.floor_rms_dps,
        "covariate": d.unknown.covariate if d.unknown else None,
    }
    return out | {"code": f"diagnosis.{d.verdict}", "values": values}


def _ties(d: Diagnosis) -> dict[str, Any]:
    """What the record cannot tell apart: single effects, and sets of which some take several."""
    rivals = [[s.term.name for s in r] for r in d.rivals]
    sets = []
    for alternatives in d.alternatives:
        if any(len(names) > 1 for names in alternatives):
            sets.append(alternatives)
            continue
        singles = [name for names in alternatives for name in names]
        tie = next((r for r in rivals if set(r) & set(singles)), None)
        if tie is None:
            rivals.append(singles)
        else:
            tie.extend(name for name in singles if name not in tie)
    return {"rivals": [r for r in rivals if len(r) > 1], "rival_sets": sets}


def reach(c: Covariates) -> dict[str, float | None]:
    """How far the motion went: fastest rate, the angle's ends, spans of temperature and supply, and of time."""

    def span(values: F64 | None, factor: float = 1.0) -> float | None:
        return None if values is None else factor * float(np.ptp(values))

    return {
        "rate_dps": float(np.quantile(np.abs(c.rate_dps), 0.999)),
        "low_deg": float(c.position_deg.min()),
        "high_deg": float(c.position_deg.max()),
        "temperature_degC": span(c.temperature_c),
        "supply_mV": span(c.supply_v, 1e3),
        "duration_s": float(c.time_s[-1]),
    }


def _missing(d: Diagnosis) -> list[dict[str, Any]]:
    """One best effect per finding, in order of entry."""
    assert d.search is not None
    assert d.after is not None
    found: list[dict[str, Any]] = []
    if d.clip is not None:
        limits = {"V_lo": d.clip.low, "V_hi": d.clip.high}
        unit = d.recording.gyro(d.axis).unit
        parameters_ = [_parameter(f"saturation.{n}", v, unit, None) for n, v in limits.items() if v is not None]
        found.append(_finding("saturation", d.clip_gain, float(np.sqrt(max(d.clip_gain, 0.0))), parameters_))
    if d.hum is not None:
        unit, hum = d.recording.gyro(d.axis).unit, d.hum
        size = _parameter("mains_hum.amplitude", hum.amplitude, unit, hum.amplitude_uncertainty)
        pitch = _parameter("mains_hum.f", hum.frequency_hz, "Hz", hum.frequency_uncertainty_hz)
        line = {"effect": "mains_hum", "two_delta_lnL": hum.two_delta_lnL, "p": hum.p, "parameters": [size, pitch]}
        found.append(line)
    unit = d.recording.gyro(d.axis).unit
    if d.walk is not None:
        size = _parameter("bias_random_walk.k", d.walk.k, f"{unit}/sqrt(s)", d.walk.k * d.walk.relative_uncertainty)
        z = float(equivalent_z(d.walk.two_delta_lnL, 2))
        found.append(_finding("bias_random_walk", d.walk.two_delta_lnL, z, [size]))
    if d.coarse is not None:
        evidence, step = on_grid(d), _parameter("adc_quantization.step", d.coarse, unit, None)
        found.append(_finding("adc_quantization", evidence, float(np.sqrt(evidence)), [step]))
    every = {p["name"]: p for p in parameters(d.after)}
    for finding in d.search.findings:
        name = finding.chosen.term.name
        own = [p for n, p in every.items() if n.startswith(f"{name}.")]
        found.append(_finding(name, finding.chosen.gain, finding.chosen.z, own))
    return found


def _finding(name: str, gain: float, z: float, parameters_: list[dict[str, Any]]) -> dict[str, Any]:
    return {"effect": name, "two_delta_lnL": gain, "p": p_value(z), "parameters": parameters_}


def parameters(explanation: Explanation) -> list[dict[str, Any]]:
    """Bias, scale factor and every parameter of the terms, with standard uncertainties, in the recording's unit."""
    space = explanation.space
    unit = space.design.averages.samples.unit
    suffix = SUFFIX[unit]
    values, covariance = explanation.solution
    known = [name in explanation.granted for name in explanation.names]
    spread = [
        None if k else float(v) for k, v in zip(known, np.sqrt(np.maximum(np.diag(covariance), 0.0)), strict=True)
    ]
    rows = [_parameter(f"bias_{suffix}", float(space.values[0] + values[0]), unit, spread[0])]
    if len(space.values) > 1:
        name = f"scale_factor_{suffix}_per_dps"
        per = "1" if unit == "deg/s" else f"{unit}/(deg/s)"
        rows.append(_parameter(name, float(space.values[1] + values[1]), per, spread[1]))
    at = space.base.shape[1]
    # Columns that act on a rate or an angle were made with the scale factor as it was before these terms were there.
    scaled = space.scale_factor / (space.scale_factor + float(values[1])) if len(space.values) > 1 else 1.0
    for term in explanation.terms:
        own = term.effect.parameters()
        as_made = term.effect.acts is Acts.OUTPUT or term.effect.about
        for k, name in enumerate(term.names):
            if name:
                u, share = spread[at + k], 1.0 if as_made or known[at + k] else scaled
                size = float(values[at + k]) * share, None if u is None else u * share
                rows.append(_parameter(f"{term.name}.{name}", size[0], _unit(own[name].unit, unit), size[1]))
        for name, value in zip(term.effect.nonlinear(), term.setting, strict=False):
            rows.append(_parameter(f"{term.name}.{name}", value, _unit(own[name].unit, unit), None))
        at += term.columns.shape[1]
    return rows


def _unit(template: str, unit: str) -> str:
    return template.replace("{out}", unit)


def _parameter(name: str, value: float, unit: str, uncertainty: float | None) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "standard_uncertainty": uncertainty}
