"""The OpenAPI description as one plain page: no script and nothing from another site; a lab may have no network."""

import json
from html import escape
from typing import Any

from server import __version__


def page(schema: dict[str, Any]) -> str:
    parts = [
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">',
        "<title>Gyrobench API</title><style>body{font:16px/1.5 system-ui;max-width:60rem;margin:2rem auto}",
        "body{padding:0 1rem}pre{overflow:auto}summary{cursor:pointer}code{font-weight:600}</style>",
        f'<h1>Gyrobench API {__version__}</h1><p>The same as <a href="/openapi.json">openapi.json</a>.</p>',
    ]
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            answers = ", ".join(
                f"{status} {answer['description']}" for status, answer in operation["responses"].items()
            )
            parts.append(
                f"<details><summary><code>{method.upper()} {escape(path)}</code> {escape(operation.get('summary', ''))}"
                f"</summary><p>{escape(operation.get('description', ''))}</p><p>{escape(answers)}</p>"
                f"<pre>{escape(_told(operation.get('parameters')))}\n{escape(_told(operation.get('requestBody')))}</pre></details>"
            )
    schemas = schema.get("components", {}).get("schemas", {})
    parts.append("<h2>Schemas</h2>")
    parts += [
        f"<details><summary><code>{escape(name)}</code></summary><pre>{escape(_told(body))}</pre></details>"
        for name, body in schemas.items()
    ]
    return "".join(parts)


def _told(part: object) -> str:
    return json.dumps(part, indent=1, ensure_ascii=False) if part else ""
