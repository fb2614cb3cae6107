"""Uploads of many files: streamed, measured, and refused with a sentence where they are made to do harm."""

import io
import stat
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from calib_core.problem import Problem
from server import batch_intake
from server.batch_intake import Intake, unpack

BOUNDARY = b"----gyro"
TYPE = "multipart/form-data; boundary=----gyro"


def part(field: str, content: bytes, name: str | None = None) -> bytes:
    told = f'; filename="{name}"' if name is not None else ""
    head = f'Content-Disposition: form-data; name="{field}"{told}\r\n\r\n'.encode()
    return b"--" + BOUNDARY + b"\r\n" + head + content + b"\r\n"


def taken(folder: Path, *parts: bytes, piece: int = 7) -> Intake:
    folder.mkdir(exist_ok=True)
    intake = Intake(folder, TYPE)
    body = b"".join(parts) + b"--" + BOUNDARY + b"--\r\n"
    for at in range(0, len(body), piece):
        intake.feed(body[at : at + piece])
    intake.finish()
    return intake


def packed(*members: tuple[str | zipfile.ZipInfo, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as out:
        for name, content in members:
            out.writestr(name, content)
    return file.getvalue()


def test_files_lie_under_their_numbers_whatever_they_are_called(tmp_path: Path) -> None:
    intake = taken(
        tmp_path / "b", part("files", b"one", "../../etc/pass\twd"), part("files", b"two\r\n", "C:\\x\\B.csv")
    )
    assert [(file["name"], file["size"]) for file in intake.files] == [("passwd", 3), ("B.csv", 5)]
    assert sorted(path.name for path in (tmp_path / "b").iterdir()) == ["000001", "000002"]
    assert (tmp_path / "b" / "000002").read_bytes() == b"two\r\n"


def test_the_fingerprint_is_of_content_names_and_settings_and_not_of_how_it_came(tmp_path: Path) -> None:
    one = [part("files", b"one", "A.csv"), part("spec", b"{}")]
    first = taken(tmp_path / "a", *one).fingerprint
    assert taken(tmp_path / "b", *one, piece=10_000).fingerprint == first
    for i, other in enumerate(
        (
            [part("files", b"two", "A.csv"), part("spec", b"{}")],
            [part("files", b"one", "B.csv"), part("spec", b"{}")],
            [part("files", b"one", "A.csv"), part("spec", b"{ }")],
        )
    ):
        assert taken(tmp_path / f"c{i}", *other).fingerprint != first


def test_one_file_over_the_limit_is_its_own_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch_intake, "MAX_BYTES", 100)
    intake = taken(tmp_path / "b", part("files", b"x" * 101, "big.csv"), part("files", b"x" * 100, "good.csv"))
    assert [file["error"] and file["error"]["code"] for file in intake.files] == ["recording.too_large", None]
    assert [path.name for path in (tmp_path / "b").iterdir()] == ["000002"]


def test_a_zip_is_unpacked_flat_and_litter_left_out(tmp_path: Path) -> None:
    archive = packed(
        ("lab/", b""), ("lab/A.csv", b"a"), ("__MACOSX/lab/._A.csv", b"x"), ("lab/.DS_Store", b"x"), ("B.csv", b"bb")
    )
    intake = taken(tmp_path / "b", part("archive", archive, "boards.zip"), piece=1000)
    assert [(file["name"], file["size"]) for file in intake.files] == [("A.csv", 1), ("B.csv", 2)]
    assert sorted(path.name for path in (tmp_path / "b").iterdir()) == ["000001", "000002"]


def link() -> zipfile.ZipInfo:
    member = zipfile.ZipInfo("A.csv")
    member.external_attr = (stat.S_IFLNK | 0o777) << 16
    return member


def locked() -> bytes:
    raw = bytearray(packed(("A.csv", b"a")))
    for at in (raw.index(b"PK\x03\x04") + 6, raw.index(b"PK\x01\x02") + 8):
        raw[at] |= 1
    return bytes(raw)


@pytest.mark.parametrize(
    ("code", "archive"),
    [
        ("batch.path_outside", lambda: packed(("../A.csv", b"a"))),
        ("batch.path_outside", lambda: packed(("good.csv", b"a"), ("lab/../../A.csv", b"a"))),
        ("batch.path_outside", lambda: packed(("/etc/passwd", b"a"))),
        ("batch.path_outside", lambda: packed(("C:\\A.csv", b"a"))),
        ("batch.path_outside", lambda: packed(("..\\A.csv", b"a"))),
        ("batch.not_a_file", lambda: packed((link(), b"/etc/passwd"))),
        ("batch.password", locked),
        ("batch.expands", lambda: packed(("A.csv", bytes(1_000_000)))),
        ("batch.bad_archive", lambda: b"PK\x03\x04 and no more"),
        ("batch.bad_archive", lambda: packed(("A.csv", b"a"))[:-10]),
        ("batch.no_files", lambda: packed(("lab/", b""))),
    ],
)
def test_an_archive_that_means_harm_is_refused_and_nothing_of_it_lies_elsewhere(
    code: str, archive: Callable[[], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_intake, "FREE_EXPANSION", 0)
    with pytest.raises(Problem) as refused:
        taken(tmp_path / "b", part("archive", archive(), "boards.zip"), piece=1 << 20)
    assert refused.value.code == code
    assert [path.name for path in tmp_path.iterdir()] == ["b"]


def test_a_member_that_lies_about_its_size_is_caught_while_it_is_unpacked(tmp_path: Path) -> None:
    raw = packed(("A.csv", bytes(1_000_000)), ("B.csv", b"good"))
    for signature, at in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
        start = raw.index(signature) + at
        raw = raw[:start] + (1000).to_bytes(4, "little") + raw[start + 4 :]
    (tmp_path / "zip").write_bytes(raw)
    bad, good = unpack(tmp_path / "zip", tmp_path)
    assert bad["error"]["code"] == "batch.bad_member"
    assert not (tmp_path / "000001").exists()
    assert (good["error"], (tmp_path / "000002").read_bytes()) == (None, b"good")


def test_a_zip_of_overlapping_members_is_refused_by_what_it_expands_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_intake, "FREE_EXPANSION", 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zipfile's, about names that are there twice
        raw = packed(*[("A.csv", bytes(100_000))] * 50)
    (tmp_path / "zip").write_bytes(raw)
    with pytest.raises(Problem, match=r"batch\.expands"):
        unpack(tmp_path / "zip", tmp_path)


@pytest.mark.parametrize(
    ("code", "parts"),
    [
        ("batch.no_files", [part("name", b"nothing")]),
        ("batch.files_and_archive", [part("files", b"a", "A.csv"), part("archive", packed(("A.csv", b"a")), "z.zip")]),
        ("batch.one_archive", [part("archive", b"a", "z.zip"), part("archive", b"a", "z.zip")]),
        ("request.unknown_field", [part("recording", b"a", "A.csv")]),
        ("batch.too_many", [part("files", b"", f"{i}.csv") for i in range(4)]),
    ],
)
def test_an_upload_that_is_no_batch_is_refused(
    code: str, parts: list[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_intake, "MOST_FILES", 3)
    with pytest.raises(Problem) as refused:
        taken(tmp_path / "b", *parts)
    assert refused.value.code == code


@pytest.mark.parametrize("kind", ["application/json", "multipart/form-data", ""])
def test_a_body_of_another_kind_is_refused_before_it_is_read(kind: str, tmp_path: Path) -> None:
    with pytest.raises(Problem, match=r"batch\.not_multipart"):
        Intake(tmp_path, kind)


def test_a_body_that_breaks_off_is_refused(tmp_path: Path) -> None:
    intake = Intake(tmp_path, TYPE)
    intake.feed(part("files", b"one", "A.csv")[:-5])
    with pytest.raises(Problem, match=r"batch\.not_multipart"):
        intake.finish()
    intake.close()
