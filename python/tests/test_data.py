"""Recordings and sessions."""

import csv
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pandas
import polars
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
    # The pendulum is upright at the end, and the motor gets the voltage that the policy gives, to the millivolt.
    upright = np.abs(np.abs(read["alpha_rad"][running][-100:]) - np.pi)
    assert upright.max() < 0.3
    wanted = np.clip(read["wanted_v"][running], -5.0, 5.0)
    assert np.nanmax(np.abs(wanted - read["voltage_v"][running])) < 0.0006
    assert read.header["policy"] == "classical"


def test_a_recording_becomes_a_table_of_pandas_or_polars_in_one_call(swing_up):
    read = qube_hil.recording(swing_up)
    for table in [pandas.DataFrame(read), polars.DataFrame(read)]:
        assert list(table.columns) == list(read) and len(table) == len(read["tick"])
        assert (table["theta_rad"].to_numpy() == read["theta_rad"]).all()
        assert list(table["phase"]) == list(read["phase"])


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


def test_a_damaged_recording_is_refused_and_a_cut_one_gives_its_whole_ticks(swing_up, tmp_path):
    data = swing_up.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 2 // 3])
    read = qube_hil.recording(cut, partial=True)
    with pytest.raises(qube_hil.RecordingError, match=f"cut.mcap.*{len(read['tick'])} ticks.*partial=True"):
        qube_hil.recording(cut)
    assert read.outcome is None and not read.is_whole and len(read["tick"]) > 50
    program("recover", cut, "--out", tmp_path / "saved.mcap", code=3)
    saved = qube_hil.recording(tmp_path / "saved.mcap")
    assert saved.outcome is None and not saved.is_whole and (saved["tick"] == read["tick"]).all()
    changed = tmp_path / "changed.mcap"
    middle = len(data) // 2
    changed.write_bytes(data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :])
    with pytest.raises(qube_hil.RecordingError, match="changed.mcap"):
        qube_hil.recording(changed)
    with pytest.raises(qube_hil.RecordingError, match="missing"):
        qube_hil.recording(tmp_path / "missing")


def test_a_session_is_read_and_stays_as_it_is(session_folder, tmp_path):
    folder = session_folder
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
    # The settings alone are a session that has not begun.
    (tmp_path / "session.toml").write_bytes((folder / "session.toml").read_bytes())
    begun = qube_hil.Session(tmp_path)
    assert (begun.candidates, begun.recommended) == ([], None)
    with pytest.raises(qube_hil.SessionError, match="needs 3 candidates"):
        begun.surrogate()


def test_a_session_in_a_folder_whose_name_is_no_utf_8_is_read(session_folder, tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/session-\xff"))
    shutil.copytree(session_folder, folder)
    best = qube_hil.Session(folder).recommended
    assert best.policy.is_file() and best.policy.is_relative_to(folder)
    assert all(path.is_file() for path in best.recordings)


def page_charts(page):
    """The charts of the surrogate's posterior in a report's page, by the name of their abscissa."""
    data = page.split('id="data">', 1)[1].split("</script>", 1)[0]
    charts = json.loads(data)["charts"]
    return {chart["x"]["label"]: chart for chart in charts if chart["series"][0]["name"] == "expected"}


def test_the_surrogate_of_a_session_has_the_numbers_of_its_report(session_folder, tmp_path):
    folder = session_folder
    charts = page_charts((folder / "report.html").read_text())
    surrogate = qube_hil.Session(folder).surrogate()
    assert list(surrogate.ranges) == qube_hil.Session(folder).psi_names
    compared = 0
    for name, (lower, upper) in surrogate.ranges.items():
        chart = charts[name]
        places = [(x, *(it["values"][row] for it in chart["series"][:3])) for row, x in enumerate(chart["xs"])]
        places = np.array([place for place in places if place[1] is not None])
        assert len(places) == 61
        at = np.linspace(lower, upper, 61)
        mean, deviation = surrogate.posterior({name: at})
        # The page has six digits.
        assert np.allclose(mean, places[:, 1], rtol=1e-5)
        assert np.allclose(mean - 2.0 * deviation, places[:, 2], rtol=1e-5, atol=1e-2)
        assert np.allclose(mean + 2.0 * deviation, places[:, 3], rtol=1e-5, atol=1e-2)
        compared += 1
    assert compared == len(charts) >= 2
    best, _ = surrogate.posterior(surrogate.recommended_psi)
    points = np.random.default_rng(0).uniform(*zip(*surrogate.ranges.values()), size=(300, compared))
    means, deviations = surrogate.posterior(points)
    assert means.shape == deviations.shape == (300,) and (deviations > 0.0).all()
    assert (means <= best[0] + 1.0).all()
    (name, (lower, upper)), *_ = surrogate.ranges.items()
    mean, _ = surrogate.posterior({name: [upper + 10.0 * (upper - lower)]})
    assert np.isfinite(mean).all()
    with pytest.raises(qube_hil.SettingsError, match="point 1 is so far from the ranges of psi.*near"):
        surrogate.posterior({name: [lower, 1e160]})
    for wrong, told in [({"M_x": 1.0}, "M_x"), (np.zeros((2, 1)), "entries"), ("x", "numbers"), ({"M_x": "y"}, "M_x")]:
        with pytest.raises(qube_hil.SettingsError, match=told):
            surrogate.posterior(wrong)
