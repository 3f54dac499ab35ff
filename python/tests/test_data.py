"""Recordings and sessions."""

import csv

import numpy as np
import pyarrow.parquet
import pytest
from conftest import program

import qube_hil


def test_a_recording_is_a_table_of_its_ticks(swing_up):
    read = qube_hil.recording(swing_up)
    assert isinstance(read, dict) and read.is_whole
    ticks = len(read["tick"])
    assert {column.shape for column in read.values()} == {(ticks,)}
    running = read["phase"] == "running"
    assert running.sum() == read.outcome["steps"] == 600
    assert set(read["phase"]) == {"settling", "running", "braking"}
    assert np.isclose(read["reward"].sum(), read.return_) and (read["reward"][~running] == 0.0).all()
    assert np.allclose(np.diff(read["time_s"]), 0.01)
    # The pendulum is upright at the end, and the motor gets what is asked for, to the millivolt.
    upright = np.abs(np.abs(read["alpha_rad"][running][-100:]) - np.pi)
    assert upright.max() < 0.3
    wanted = np.clip(read["wanted_v"][running], -5.0, 5.0)
    assert np.nanmax(np.abs(wanted - read["voltage_v"][running])) < 0.0006
    assert read.header["policy"] == "classical"


def test_a_parquet_table_has_the_numbers_of_the_recording(swing_up, tmp_path):
    for format in ["csv", "parquet"]:
        program("export", swing_up, "--out", tmp_path, "--format", format)
    table = pyarrow.parquet.read_table(tmp_path / f"{swing_up.stem}.parquet")
    read = qube_hil.recording(swing_up)
    for column in ["theta_rad", "alpha_rad", "theta_dot_rad_s", "alpha_dot_rad_s", "voltage_v"]:
        assert (table[column].to_numpy() == read[column]).all()
    with (tmp_path / f"{swing_up.stem}.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert table.column_names == list(rows[0]) and table.num_rows == len(rows)
    for name in table.column_names:
        kind = float if str(table.schema.field(name).type) in ("double", "float") else int
        expected = [kind(row[name]) if row[name] else None for row in rows]
        if str(table.schema.field(name).type) == "float":
            expected = [None if it is None else float(np.float32(it)) for it in expected]
        assert table[name].to_pylist() == expected, name


def test_a_damaged_recording_is_refused_and_a_cut_one_gives_what_is_there(swing_up, tmp_path):
    data = swing_up.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 2 // 3])
    read = qube_hil.recording(cut)
    assert read.outcome is None and not read.is_whole and len(read["tick"]) > 50
    changed = tmp_path / "changed.mcap"
    middle = len(data) // 2
    changed.write_bytes(data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :])
    with pytest.raises(qube_hil.RecordingError, match="changed.mcap"):
        qube_hil.recording(changed)
    with pytest.raises(qube_hil.RecordingError, match="missing"):
        qube_hil.recording(tmp_path / "missing")


def test_a_session_is_read_and_stays_as_it_is(tmp_path):
    folder = tmp_path / "session"
    program(
        "session", "--clock", "virtual", "--preset", "quick", "--candidates", 1, "--out", folder
    )
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    session = qube_hil.Session(folder)
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert [candidate.number for candidate in session.candidates] == list(range(len(session.candidates)))
    best = session.recommended
    assert best.mean_return == max(
        it.mean_return for it in session.candidates if it.purpose == best.purpose
    )
    assert np.isclose(best.mean_return, np.mean(best.returns))
    assert "log_width" in session.psi_names and list(best.psi) == session.psi_names
    for candidate in session.candidates:
        for path, return_ in zip(candidate.recordings, candidate.returns, strict=True):
            assert return_ is None or qube_hil.recording(path).return_ == return_
    assert qube_hil.Policy.load(best.policy).kind == "network"
    with pytest.raises(qube_hil.SessionError, match="session.toml"):
        qube_hil.Session(tmp_path)
