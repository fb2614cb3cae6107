"""A certificate as one tidy table: every certified number, every point and reading, and where they come from."""

import csv
import io
from collections.abc import Iterator, Mapping
from typing import Any

from calib_core.certificate import FIELDS, MEASURED
from server.certify import taken_out
from server.documents import warning_sentence

COLUMNS = (
    "section", "axis", "name", "set_point", "reading", "value", "standard_uncertainty", "expanded_uncertainty", "unit",
)  # fmt: skip
IDENTITY = ("number", "verdict", "board", "operator", "note", "profile", "started_at", "finished_at", "issued_at")
# A cell that begins so is a formula to a spreadsheet; text from people must stay text.
FORMULA = ("=", "+", "-", "@", "\t", "\r")


def render_csv(content: Mapping[str, Any]) -> bytes:
    file = io.StringIO(newline="")
    table = csv.DictWriter(file, COLUMNS, restval="", lineterminator="\r\n")
    table.writeheader()
    table.writerows(_rows(content))
    return file.getvalue().encode()


def _rows(content: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    said = [(name, content.get(name)) for name in IDENTITY]
    said += [("gyro_model", content["gyro_model"]["name"]), ("rig", content["rig"]["url"])]
    said += [(f"recording_{name}", value) for name, value in content["recording"].items()]
    said += [("software", "{name} {version}".format(**content["software"]))]
    said += [(name, value) for name, value in content["conditions"].items()]
    for name, value in said:
        yield {"section": "identity", "name": name, "value": _text(value)}
    for axis, figures in content["axes"].items():
        for field in FIELDS:
            value = field.of(figures)
            if value is None:
                continue
            row = {"section": "result", "axis": axis, "name": ".".join(field.path), "unit": _unit(field.path[-1])}
            measured = figures[field.path[0]] if field.measured else {"value": value}
            yield row | {key: measured[key] for key in measured if key in COLUMNS}
    for told in taken_out(content):
        for parameter in told["parameters"]:
            row = {"section": "compensation", "axis": told["axis"]}
            yield row | {key: parameter[key] for key in ("name", "value", "unit", "standard_uncertainty")}
    for name, state in content["states"].items():
        for test, points in state.get("points", {}).items():
            for point in points:
                yield from _point(name, state, test, point)
    for limit in content["judgement"]:
        row = {"section": "limit met" if limit["ok"] else "limit not met", "axis": limit["axis"]}
        row["unit"] = _unit(next(key for key in reversed(limit["path"]) if key not in MEASURED))
        for bound in ("min", "max"):
            if limit[bound] is not None:
                yield row | {"name": ".".join([*limit["path"], bound]), "value": limit[bound]}
    for warning in content["warnings"]:
        yield {
            "section": "warning",
            "name": warning["code"],
            "value": warning_sentence(warning),
        }


def _point(name: str, state: Mapping[str, Any], test: str, point: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    unit = "deg/s" if name.startswith("rate") else "deg"
    row = {"section": f"{name}/{test}", "axis": state["axis"], "set_point": point["set_point"], "unit": unit}
    yield row | {"name": "reference", "value": point["reference"]}
    for number, reading in enumerate(point["readings"], start=1):
        yield row | {"name": "gyro", "reading": number, "value": reading}


def _unit(name: str) -> str:
    units = {"bias_V": "V", "scale_factor_V_per_dps": "V/(deg/s)", "delay_s": "s"}
    endings = {"_pct_fs": "%FS", "_pct": "%", "_dps": "deg/s", "_deg": "deg"}
    return units.get(name) or next(unit for ending, unit in endings.items() if name.endswith(ending))


def _text(value: object) -> str:
    words = "" if value is None else str(value)
    return f"'{words}" if isinstance(value, str) and words.startswith(FORMULA) else words
