"""Gyro models: the presets as their datasheets have them, and the operator's own."""

from fastapi import APIRouter, Response

from calib_core.gyro_models import GyroModel
from server.api import models
from server.api.common import Here
from server.problems import declared

router = APIRouter(prefix="/gyro-models", tags=["gyro models"])


def shown(model: GyroModel) -> models.GyroModelAnswer:
    return models.GyroModelAnswer(**model.to_json())


@router.get("", summary="All gyro models, presets first")
def gyro_models(here: Here) -> models.GyroModels:
    return models.GyroModels(items=[shown(model) for model in here.store.gyro_models.find()])


@router.post("", status_code=201, summary="Keep a gyro model", responses=declared(409))
def add(body: models.GyroModelBody, here: Here) -> models.GyroModelAnswer:
    model = GyroModel.from_json(body.model_dump(exclude_none=True))
    return shown(here.store.gyro_models.save(model, new=True))


@router.get("/{model}", summary="One gyro model", responses=declared(404))
def gyro_model(model: str, here: Here) -> models.GyroModelAnswer:
    return shown(here.store.gyro_models.get(model))


@router.put("/{model}", summary="Change an own gyro model", responses=declared(404, 409))
def change(model: str, body: models.GyroModelFacts, here: Here) -> models.GyroModelAnswer:
    given = GyroModel.from_json({**body.model_dump(exclude_none=True), "id": model})
    return shown(here.store.gyro_models.save(given, new=False))


@router.delete("/{model}", status_code=204, summary="Forget an own gyro model", responses=declared(404, 409))
def delete(model: str, here: Here) -> Response:
    here.store.gyro_models.delete(model)
    return Response(status_code=204)
