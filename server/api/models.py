"""Bodies as they are asked for and given, with their bounds; FastAPI makes OpenAPI of them."""

import warnings
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from pydantic.warnings import UnsupportedFieldAttributeWarning

from calib_core.problem import Problem
from server.store_db import ID_PATTERN, checked_id

# FastAPI silences this where it builds its fields; ours are built when first asked for.
warnings.filterwarnings("ignore", category=UnsupportedFieldAttributeWarning)

Axis = Literal["x", "z"]
StateName = Literal["estimate_x", "rate_x", "position_x", "estimate_z", "rate_z", "position_z"]
AnyState = StateName | Literal["experiment"]
Profile = Literal["standard", "thesis"]
RunStatus = Literal["queued", "running", "finished", "stopped", "failed", "interrupted"]
Verdict = Literal["pass", "fail", "issued"]


def _one_line(text: str) -> str:
    if any(ord(letter) < 32 or ord(letter) == 127 for letter in text):
        raise Problem("request.control_characters")
    return text


def _board(text: str) -> str:
    return checked_id(text, "board")


def _model(text: str) -> str:
    return checked_id(text, "gyro_model")


# Patterns are told in OpenAPI and refused in our own words.
_LINE = Field(json_schema_extra={"pattern": r"^[^\x00-\x1f\x7f]*$"})
_ID = Field(json_schema_extra={"pattern": ID_PATTERN})
Line = Annotated[str, Field(max_length=200), _LINE, AfterValidator(_one_line)]
Note = Annotated[str, Field(max_length=2000)]
BoardId = Annotated[str, _ID, AfterValidator(_board)]
ModelId = Annotated[str, _ID, AfterValidator(_model)]
Speed = Annotated[float, Field(ge=1, le=1000)] | Literal["max"]


class Body(BaseModel):
    """What a client sends: nothing unknown, no infinities, no text where a number is asked."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True, defer_build=True)


class Answer(BaseModel):
    model_config = ConfigDict(extra="allow", defer_build=True)


class Plain(BaseModel):
    """These fields and no others; like all of them, built when it is first asked for."""

    model_config = ConfigDict(defer_build=True)


# --- boards and gyro models ------------------------------------------------------------------------------------
class BoardBody(Body):
    id: BoardId
    gyro_model: ModelId = "LPY503AL-OUT"
    note: Note = ""


class BoardChange(Body):
    gyro_model: ModelId | None = None
    note: Note | None = None


class Board(Answer):
    id: str
    gyro_model: str
    note: str
    created_at: str
    runs: int | list[dict[str, Any]] | None = None
    certificates: int | list[dict[str, Any]] | None = None


class Boards(Plain):
    items: list[Board]
    next: str | None


Positive = Annotated[float, Field(gt=0, le=1e4)]


class DatasheetBody(Body):
    bias_V: float = Field(ge=-100, le=100)
    scale_factor_V_per_dps: float = Field(ge=-10, le=10)
    range_dps: Positive


class RangesBody(Body):
    rate_dps: Positive | None = None
    position_deg: Annotated[float, Field(gt=0, le=150)] | None = None
    sine_deg: Annotated[float, Field(gt=0, le=150)] | None = None


RangesByAxis = dict[Axis, RangesBody]


class GyroModelFacts(Body):
    name: Line = ""
    axes: dict[Axis, DatasheetBody] = Field(min_length=1)
    output_min_V: float = Field(0.0, ge=-100, le=100)
    output_max_V: float = Field(3.0, ge=-100, le=100)
    ranges: RangesByAxis = {}


class GyroModelBody(GyroModelFacts):
    id: ModelId


class GyroModelAnswer(Answer):
    id: str
    name: str
    preset: bool
    axes: dict[str, dict[str, float]]
    ranges: dict[str, dict[str, float]]
    output_min_V: float
    output_max_V: float


class GyroModels(Plain):
    items: list[GyroModelAnswer]
    next: None = None


# --- runs ------------------------------------------------------------------------------------------------------
class Conditions(Body):
    room_temperature_degC: float | None = Field(default=None, ge=-60, le=150)


class RunBody(Body):
    board: BoardId
    gyro_model: ModelId | None = Field(None, description="the board's own where it is left out")
    profile: Profile = "standard"
    states: list[StateName] | None = Field(None, min_length=1, max_length=6, description="only these")
    readings: int | None = Field(None, ge=3, le=1000, description="replaces the 22 of each repeat test")
    operator: Line = ""
    note: Note = ""
    seed: int | None = Field(None, ge=0, lt=2**53)
    ranges: RangesByAxis | None = None
    conditions: Conditions = Conditions()
    spec: dict[str, Any] | None = None
    continues: str | None = Field(None, max_length=64, description="a run whose other states are taken over")
    speed: Speed | None = None


class StatePlan(Plain):
    name: StateName
    seconds: float
    readings: int


class PlanAnswer(Plain):
    states: list[StatePlan]
    seconds: float


class Message(Plain):
    code: str
    values: dict[str, Any]
    sentence: str


class RunState(Plain):
    name: AnyState
    status: Literal["waiting", "running", "done", "failed", "kept"]
    result: dict[str, Any] | None


class Run(Answer):
    id: str
    status: RunStatus
    recording: str
    board: str
    gyro_model: str
    profile: Profile
    states: list[RunState]
    operator: str
    note: str
    seed: int
    readings: int
    conditions: dict[str, Any]
    rig: str
    created_at: str
    started_at: str | None
    finished_at: str | None
    message: Message | None
    certificate: str | None
    duration_s: float | None
    plan: dict[str, Any]
    results: dict[str, Any]


class Runs(Plain):
    items: list[Run]
    next: str | None


class Series(Plain):
    columns: dict[str, list[float | None]]


# --- recordings and certificates -------------------------------------------------------------------------------
class RecordingAnswer(Answer):
    id: str
    name: str
    board: str
    run: str | None
    source: str
    header: dict[str, str]
    digest: str | None
    samples: int
    duration_s: float
    created_at: str


class Recordings(Plain):
    items: list[RecordingAnswer]
    next: str | None


class CertificateBody(Body):
    recording: str = Field(max_length=64)
    model: ModelId | None = Field(None, description="a gyro model, or a saved model whose effects are taken out first")
    models: list[ModelId] = Field([], max_length=3, description="saved models, of one axis each")
    spec: dict[str, Any] | None = None


class CertificateRow(Answer):
    number: str
    board: str
    recording: str
    verdict: Verdict
    issued_at: str
    operator: str


class Certificates(Plain):
    items: list[CertificateRow]
    next: str | None


class Certificate(Answer):
    number: str
    issued_at: str
    board: str
    verdict: Verdict
    axes: dict[str, Any]
    recording: dict[str, Any]
    warnings: list[dict[str, Any]]


class Verified(Answer):
    valid: bool


# --- rig -------------------------------------------------------------------------------------------------------
class RigBody(Body):
    url: Annotated[str, Field(min_length=1, max_length=400), _LINE, AfterValidator(_one_line)]
    speed: Speed | None = None


class StartCheckBody(Body):
    gyro_model: Annotated[str, Field(min_length=1, max_length=80)] = "LPY503AL-OUT"


class EncoderPairs(Body):
    points: Annotated[
        list[Annotated[list[float], Field(min_length=2, max_length=2)]],
        Field(min_length=2, max_length=200, description="[what the encoder read, the true angle] in deg"),
    ]
    standard_uncertainty_deg: Annotated[float, Field(gt=0, lt=10, description="of each true angle")]


class ReferenceBody(Body):
    """How the encoders of the rig were calibrated."""

    date: Line
    means: Line
    by: Line = ""
    axes: dict[Axis, EncoderPairs]


class ReferenceGain(Plain):
    """What follows for one axis: true degrees for one of the encoder's, and its relative standard uncertainty."""

    scale: float
    scale_uncertainty: float


class Reference(Answer):
    record: dict[str, Any] | None
    name: str
    gains: dict[str, ReferenceGain]


class LeaseBody(Body):
    holder: Annotated[str, Field(min_length=1, max_length=80), _LINE, AfterValidator(_one_line)]


class Lease(Plain):
    token: str
    expires_at: str


class Held(Plain):
    holder: str
    expires_at: str


class Part(Plain):
    part: str
    ok: bool | None
    code: str
    values: dict[str, Any]
    sentence: str
    cure: str = ""


class Rig(Answer):
    url: str
    kind: str
    simulated: bool
    speed: float | Literal["max"]
    connected: bool
    parts: list[Part]
    checks: list[Part]
    checking: bool
    lease: Held | None
    run: str | None
    axes: dict[str, dict[str, Any]]
    ports: list[str]
    choices: list[dict[str, str]]
