"""A certificate as PDF: this module finds the words and the numbers, certificate.typ sets them.

Everything reaches Typst as one JSON string in `sys.inputs`, never as source, so a board named `#panic()` is only a
name. Fonts are the packages' own and the time stamp is the day of issue, so the bytes depend on the content alone.
"""

import datetime
import json
import math
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from calib_core.certificate import FIELDS, TEST_DECIMALS, Field, two_digits
from server.certify import taken_out
from server.documents import compensation_words, figure_name, warning_sentence
from server.texts import render

TEMPLATE = Path(__file__).with_name("certificate.typ")
BY_PATH = {field.path: field for field in FIELDS}
LONGEST_WORD = 28
MINUS = "−"
NO_TEST: Mapping[str, Any] = {"points": {"repeat": []}}


def render_pdf(content: Mapping[str, Any], lang: str) -> bytes:
    """One to two pages A4 in `lang` ("en" or "th")."""
    import fontpkg
    import typst

    issued = datetime.datetime.fromisoformat(content["issued_at"]).replace(microsecond=0)
    return typst.compile(
        str(TEMPLATE),
        font_paths=[str(fontpkg.path("Sarabun").parent)],
        ignore_system_fonts=True,
        sys_inputs={"certificate": json.dumps(page(content, lang), ensure_ascii=False)},
        timestamp=issued,
    )


def page(content: Mapping[str, Any], lang: str) -> dict[str, Any]:
    """What stands on the certificate, as strings in order: the template only places them."""

    def say(key: str, **values: object) -> str:
        return inert(render(f"certificate.{key}", values, lang))

    axes = content["axes"]
    return {
        "lang": lang,
        "title": say("title"),
        "subject": say("subject"),
        "number": inert(content["number"]),
        "number_label": say("number"),
        "page": say("page", page="%1", pages="%2"),
        "end": say("end"),
        "simulated": say("simulated") if content["rig"]["simulated"] else None,
        "identity": [[say(f"identity.{name}"), inert(value)] for name, value in _identity(content, lang)],
        "verdict": {"kind": content["verdict"], "text": _verdict(content, lang)},
        "axes": [say("axis", axis=axis) for axis in axes],
        "estimate": {"title": say("estimate"), "rows": list(_estimate(content, lang))},
        "tests": {"title": say("tests"), **_tests(content, lang)},
        "repeats": list(_repeats(content, lang)),
        "plots": [plot for name, state in content["states"].items() if (plot := _plot(name, state, lang))],
        "statements": [{"title": say(f"{name}.title"), "text": text} for name, text in _statements(content, lang)],
        "spec": {
            "title": say("spec", name=(content["spec"] or {}).get("name") or "–"),
            "head": [say(f"limits.{name}") for name in ("figure", "limit")],
            "failed": say("limits.not_ok"),
            "rows": _limits(content, lang),
        },
        "warnings": {
            "title": say("warnings"),
            "rows": [inert(warning_sentence(told, lang)) for told in content["warnings"]],
        },
        "authorised": say("authorised"),
        "digest": content["recording"]["digest"],
    }


def inert(value: object) -> str:
    """A person's text as one printable line: no control or direction marks, and no word too long to break."""
    if value is None or value == "":
        return "–"
    words = "".join(" " if unicodedata.category(c) in ("Cc", "Zl", "Zp") else c for c in str(value))
    words = "".join(c for c in words if unicodedata.category(c) not in ("Cf", "Cs", "Co", "Cn"))
    return re.sub(rf"([!-~]{{{LONGEST_WORD}}})(?=[!-~])", "\\1\u200b", words).strip() or "–"


def signed(text: str) -> str:
    return text.replace("-", MINUS)


# --- identity and verdict ------------------------------------------------------------------------------------------
def _identity(content: Mapping[str, Any], lang: str) -> Iterator[tuple[str, object]]:
    model, rig, recording, software = (content[name] for name in ("gyro_model", "rig", "recording", "software"))
    temperature = content["conditions"].get("room_temperature_degC")
    yield "board", content["board"]
    yield "gyro_model", model["name"]
    yield "axes", ", ".join(content["axes"])
    yield "operator", content["operator"]
    yield "performed", _span(_time(content["started_at"]), _time(content["finished_at"]))
    yield "issued", _time(content["issued_at"])
    yield "temperature", None if temperature is None else f"{temperature:g} °C"
    yield "rig", rig["url"]
    if "skew_ppm" in rig.get("clock", {}):
        yield "clocks", render("certificate.clocks", rig["clock"], lang)
    yield "profile", render(f"profile.{content['profile']}", {}, lang)
    yield "readings", content["readings"]
    yield "recording", recording["id"]
    yield "samples", f"{recording['samples']:,} / {recording['duration_s']:.1f} s".replace(",", "\u202f")
    yield "software", f"{software['name']} {software['version']}"
    yield "note", content["note"]


def _time(value: str | None) -> str | None:
    """RFC 3339 as it is read by people, still with its zone."""
    if not value:
        return None
    return datetime.datetime.fromisoformat(value).astimezone(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")


def _span(start: str | None, end: str | None) -> str | None:
    """From start to end, the day once where it is the same."""
    if start is None or end is None:
        return start or end
    return f"{start.removesuffix(' UTC')} – {end[11:] if end[:10] == start[:10] else end}"


def _verdict(content: Mapping[str, Any], lang: str) -> str:
    kept = sum(bool(row["ok"]) for row in content["judgement"])
    values = {"kept": kept, "limits": len(content["judgement"]), "spec": (content["spec"] or {}).get("name") or "–"}
    return inert(render(f"certificate.verdict.{content['verdict']}", values, lang))


# --- tables ----------------------------------------------------------------------------------------------------------
def _estimate(content: Mapping[str, Any], lang: str) -> Iterator[dict[str, Any]]:
    """Bias and scale factor large, with what stands beside them; then delay and step check where measured."""
    axes = content["axes"]

    def row(key: str, field: Field, values: Sequence[str] | None = None, style: str = "") -> dict[str, Any]:
        written = values or [signed(field.written(axis)) for axis in axes.values()]
        return {"label": render(key, {}, lang), "unit": field.unit, "values": written, "style": style}

    for name in ("bias_V", "scale_factor_V_per_dps"):
        field = BY_PATH[(name,)]
        yield row(field.text, field, style="strong")
        yield row("certificate.expanded", field, [_expanded(field, axis) for axis in axes.values()], "minor")
        yield row("certificate.adaptive", BY_PATH[("adaptive", name)], style="minor")
        sheets = content["gyro_model"]["axes"]
        promised = [_datasheet(field, sheets.get(axis), figures) for axis, figures in axes.items()]
        yield row("certificate.datasheet", field, promised, "minor")
    for path in (("delay_s",), ("step_check", "rate_error_pct"), ("step_check", "position_error_pct")):
        if any(BY_PATH[path].of(axis) is not None for axis in axes.values()):
            yield row(BY_PATH[path].text, BY_PATH[path])


def _expanded(field: Field, axis: Mapping[str, Any]) -> str:
    measured = axis.get(field.path[0])
    return "–" if measured is None else two_digits(measured["expanded_uncertainty"] * field.factor)


def _datasheet(field: Field, sheet: Mapping[str, float] | None, axis: Mapping[str, Any]) -> str:
    """The datasheet's value, and how far the measured one is from it."""
    if sheet is None:
        return "–"
    promised, value = sheet[field.path[0]], field.of(axis)
    away = "" if value is None else f" ({100 * (value / promised - 1):+.1f} %)"
    return signed(f"{promised * field.factor:g}{away}")


def _tests(content: Mapping[str, Any], lang: str) -> dict[str, Any]:
    """The figures of both tests side by side: rate x, rate z, position x, position z."""
    axes = content["axes"]
    kinds = [
        (kind, unit) for kind, unit in (("rate", "deg/s"), ("position", "deg")) if any(kind in a for a in axes.values())
    ]
    columns = [(kind, axis) for kind, _ in kinds for axis in axes]
    by_label: dict[str, list[str]] = {}
    for kind, axis in columns:
        for field in FIELDS:
            if field.path[0] == kind:
                label = render(field.text, {}, lang) + (", %FS" if field.unit == "%FS" else "")
                by_label.setdefault(label, []).append(signed(field.written(axes[axis])))
    return {
        "head": [f"{render(f'certificate.{kind}', {}, lang)}, {unit}" for kind, unit in kinds],
        "rows": [{"label": label, "values": values} for label, values in by_label.items()],
    }


def _repeats(content: Mapping[str, Any], lang: str) -> Iterator[dict[str, Any]]:
    """Bias error and random error at each set-point of the repeat tests (thesis 5.7-5.10, 5.15-5.18)."""
    for kind, unit in (("rate", "deg/s"), ("position", "deg")):
        of_axis = [
            {
                point["set_point"]: point
                for point in content["states"].get(f"{kind}_{axis}", NO_TEST)["points"]["repeat"]
            }
            for axis in content["axes"]
        ]
        set_points = sorted({at for points in of_axis for at in points})
        if set_points:
            yield {
                "title": render(f"certificate.repeats.{kind}", {}, lang),
                "set_point": render("certificate.repeats.set_point", {"unit": unit}, lang),
                "bias_error": render("certificate.repeats.bias_error", {}, lang),
                "random_error": "2·S",
                "rows": [[signed(f"{at:g}"), *_errors(at, of_axis, TEST_DECIMALS[kind])] for at in set_points],
            }


def _errors(set_point: float, of_axis: Sequence[Mapping[float, Mapping[str, Any]]], decimals: int) -> Iterator[str]:
    for points in of_axis:
        for name in ("bias_error", "random_error"):
            value = points.get(set_point, {}).get(name)
            yield "–" if value is None else signed(f"{value:.{decimals}f}")


def _limits(content: Mapping[str, Any], lang: str) -> list[dict[str, Any]]:
    """One row a figure and its limits, with what each axis that they hold for has measured."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for limit in content["judgement"]:
        field = BY_PATH[tuple(name for name in limit["path"] if name != "value")]
        low, high, value = (
            None if limit[key] is None else f"{limit[key] * field.factor:.5g}" for key in ("min", "max", "value")
        )
        bounds = signed(", ".join(filter(None, (low and f"≥ {low}", high and f"≤ {high}"))))
        name = f"{figure_name(field, lang)}, {field.unit}"
        row = rows.setdefault((name, bounds), {"figure": name, "limit": bounds, "axes": {}})
        row["axes"][limit["axis"]] = {"value": signed(value or "–"), "ok": bool(limit["ok"])}
    return [{**row, "axes": [row["axes"].get(axis) for axis in content["axes"]]} for row in rows.values()]


# --- plots -----------------------------------------------------------------------------------------------------------
def _plot(name: str, state: Mapping[str, Any], lang: str) -> dict[str, Any] | None:
    """The linearity test of one state in data units, with ticks: means on the fitted line, residuals under it."""
    points: Sequence[Mapping[str, Any]] = state.get("points", {}).get("linearity", ())
    if len(points) < 2:
        return None
    kind = name.split("_")[0]
    unit = "deg/s" if kind == "rate" else "deg"
    x = [point["reference"] for point in points]
    residual = [point["residual"] for point in points]
    spread = [(reading - point["mean"]) ** 2 for point in points for reading in point["readings"]]
    freedom = len(spread) - len(points)
    readings = len(spread) / len(points)
    # Two standard uncertainties of a plotted mean, from the scatter of its readings.
    band = 2 * math.sqrt(sum(spread) / freedom / readings) if freedom > 0 else 0.0
    reach = max(map(abs, [*x, *(point["mean"] for point in points)])) * 1.06
    deep = max(band, *map(abs, residual)) * 1.25 or 1.0
    return {
        "title": render(f"certificate.plot.{kind}", {"axis": state["axis"]}, lang),
        "x_label": render(f"certificate.plot.reference_{kind}", {}, lang),
        "y_label": render(f"certificate.plot.gyro_{kind}", {}, lang),
        "residual_label": render("certificate.plot.residual", {"unit": unit}, lang),
        "band_label": render("certificate.plot.band", {}, lang),
        "line_label": _equation(state["slope"], state["intercept"], unit),
        "reach": reach,
        "deep": deep,
        "band": band,
        "ticks": _ticks(reach),
        "residual_ticks": _ticks(deep, 2),
        "line": [state["slope"], state["intercept"]],
        "points": [[a, point["mean"], r] for a, point, r in zip(x, points, residual, strict=True)],
    }


def _equation(slope: float, intercept: float, unit: str) -> str:
    return f"y = {signed(f'{slope:.5f}')} x {MINUS if intercept < 0 else '+'} {abs(intercept):.4f} {unit}"


def _ticks(reach: float, wanted: int = 3) -> list[list[Any]]:
    """Round numbers from -reach to reach, about `wanted` on each side of zero, with their labels."""
    rough = reach / wanted
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= rough * 0.95)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9)) + (1 if round(step / power, 3) == 2.5 else 0)
    n = math.floor(reach / step + 1e-9)
    return [[i * step, signed(f"{i * step:.{decimals}f}") if i else "0"] for i in range(-n, n + 1)]


# --- statements ------------------------------------------------------------------------------------------------------
def _statements(content: Mapping[str, Any], lang: str) -> Iterator[tuple[str, str]]:
    def say(key: str, **values: object) -> str:
        return render(f"certificate.{key}", values, lang)

    yield "method", " ".join([say(f"method.{content['profile']}"), say("method.tests")])
    models = taken_out(content)
    if models:
        said = " ".join(say("compensation.text", **compensation_words(one)) for one in models)
        yield "compensation", inert(said)
    calibrated = content["rig"]["reference_calibration"]
    reference = "calibrated" if calibrated else "uncalibrated"
    yield "traceability", say(f"traceability.{reference}", reference=inert(calibrated))
    budgets = [rows for state in content["states"].values() for rows in state.get("budget", {}).values()]
    named: dict[str, str] = {}
    for part, excluded in (("included", False), ("excluded", True)):
        names = dict.fromkeys(row["name"] for rows in budgets for row in rows if row.get("excluded", False) == excluded)
        named[part] = ", ".join(render(f"budget.{name}", {}, lang) for name in names) or "–"
    yield "uncertainty", " ".join([say("uncertainty.included", **named), say("uncertainty.excluded", **named)])
    rule = [say("scope.rule")] if content["spec"] else []
    yield "scope", " ".join([say("scope.items"), *rule, say("scope.again")])
