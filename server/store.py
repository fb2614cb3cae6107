"""The store: boards, gyro models, runs, recordings and certificates in one SQLite file (WAL).

The worker writes samples and results, the server everything else; each process opens its own Store on the same
directory, and SQLite lets one write at a time.
"""

from pathlib import Path
from typing import Any

from calib_core.recording import Recording
from server.settings import data_dir
from server.store_batches import Batches
from server.store_boards import Boards, GyroModels
from server.store_certificates import Certificates
from server.store_db import Connection
from server.store_effects import Effects
from server.store_experiments import Experiments
from server.store_lab import Lab
from server.store_models import Models
from server.store_notebooks import Notebooks
from server.store_recordings import Recordings
from server.store_rig import RigRecords
from server.store_runs import Runs


class Store:
    def __init__(self, data: str | Path | None = None) -> None:
        """Opens, or makes, the store in ``data`` (None: the user's own). Raises Problem where it cannot."""
        self.data = data_dir(data)
        self.connection = Connection(self.data)
        self.boards = Boards(self.connection)
        self.gyro_models = GyroModels(self.connection)
        self.runs = Runs(self.connection)
        self.recordings = Recordings(self.connection)
        self.certificates = Certificates(self.connection)
        self.models = Models(self.connection)
        self.effects = Effects(self.connection)
        self.experiments = Experiments(self.connection)
        self.rig_records = RigRecords(self.connection)
        self.notebooks = Notebooks(self.connection)
        self.lab = Lab(self.connection)
        self.batches = Batches(self.connection)

    def recording(self, recording: str) -> Recording:
        return self.recordings.load(recording)

    def issue_certificate(self, content: dict[str, Any]) -> dict[str, Any]:
        return self.certificates.issue(content)

    def close(self) -> None:
        self.connection.close()

    def __enter__(self) -> "Store":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
