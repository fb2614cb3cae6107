"""Whatever a client sends, the server answers as its OpenAPI description says (schemathesis, seeded)."""

import os
from collections.abc import Iterator
from itertools import product
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from running import Server
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    negative_data_rejection,
    response_schema_conformance,
    status_code_conformance,
    unsupported_method,
)

CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
    negative_data_rejection,
    unsupported_method,
]


EXAMPLES = int(os.environ.get("GYROBENCH_EXAMPLES", "3"))


@pytest.fixture(scope="module")
def described(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    server = Server(tmp_path_factory.mktemp("schema"))
    server.worker_ready()
    server.client.post("/boards", json={"id": "B"})
    yield schemathesis.openapi.from_url(f"{server.address}/openapi.json")
    server.close()


def test_every_answer_is_as_described(described: Any) -> None:
    operations = [found.ok() for found in described.get_all_operations()]
    operations = [found for found in operations if found.path != "/api/v1/thesis"]  # seconds, and never another answer
    assert len(operations) > 30
    failed = []
    for operation, mode in product(operations, (GenerationMode.POSITIVE, GenerationMode.NEGATIVE)):
        if mode is GenerationMode.NEGATIVE and not (operation.body or operation.query):
            continue  # nothing that could be wrong

        @settings(
            max_examples=EXAMPLES,
            derandomize=True,
            deadline=None,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(case=operation.as_strategy(mode))
        def answers(case: schemathesis.Case) -> None:
            case.call_and_validate(checks=CHECKS, timeout=60)

        try:
            answers()
        except (AssertionError, ExceptionGroup) as failure:
            failed.append(f"{operation.label}, {mode.value}\n{failure}")
    assert not failed, "\n\n".join(failed)
