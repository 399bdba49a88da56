"""Where a slice goes through: rows of a table of points."""

from pathlib import Path

import pandas as pd
import pytest
import torch

import gradscape as gs
from gradscape.envs.adapters import from_torch
from gradscape.jobs.cut import points_in
from gradscape.jobs.scene import named_point
from gradscape.landscapes.space import ParameterSpace

SPACE = ParameterSpace({"mass": (0.0, 4.0, "kg"), "speed": (-1.0, 1.0, "m/s")})
ROWS = {"speed [m/s]": [0.1, 0.2, 0.3, 0.4], "mass": [1.0, 2.0, 3.0, 4.0], "note": ["a", "b", "c", "d"]}
BOWL = from_torch(lambda x: (x**2).sum(dim=-1), SPACE)


def table(path: Path, **more: list[float | None]) -> Path:
    frame = pd.DataFrame(ROWS | more)
    frame.to_parquet(path) if path.suffix == ".parquet" else frame.to_csv(path, index=False)
    return path


@pytest.mark.parametrize("name", ["points.csv", "Points.CSV", "points.parquet"])
def test_a_row_and_the_best_row_are_points(tmp_path: Path, name: str) -> None:
    path = table(tmp_path / name, loss=[3.0, None, 0.5, 2.0])
    row = 2 if path.suffix == ".parquet" else 3  # of the file: row 1 of a CSV file is its heading
    assert named_point(BOWL, f"{path}:{row}").tolist() == [2.0, 0.2]
    assert named_point(BOWL, str(path)).tolist() == [3.0, 0.3]


def test_an_environment_goes_through_them_too(tmp_path: Path) -> None:
    env = gs.make("bounce", device="cpu")
    frame = pd.DataFrame([env.space.uniform(1, seed=3)[0].tolist()], columns=list(env.space.names))
    frame.to_csv(tmp_path / "one.csv", index=False)
    assert torch.equal(named_point(env, str(tmp_path / "one.csv")), env.space.uniform(1, seed=3)[0])
    (tmp_path / "plain.csv").write_text(",".join(map(str, env.space.center.tolist())))  # a file of numbers, as before
    assert torch.equal(named_point(env, str(tmp_path / "plain.csv")), env.space.center)


def test_what_names_no_row_is_refused(tmp_path: Path) -> None:
    path = table(tmp_path / "points.csv")
    with pytest.raises(ValueError, match="4 rows and no column 'loss'; choose one"):
        named_point(BOWL, str(path))
    for row in ("0", "1", "6"):
        with pytest.raises(ValueError, match=rf"has points in rows 2 to 5 \(1 is the heading\); got row {row}"):
            named_point(BOWL, f"{path}:{row}")
    with pytest.raises(ValueError, match="has points in rows 1 to 4; got row 5"):
        named_point(BOWL, f"{table(tmp_path / 'points.parquet')}:5")
    with pytest.raises(ValueError, match=r"no row of .* has a loss"):
        named_point(BOWL, str(table(tmp_path / "lost.csv", loss=[None] * 4)))
    (tmp_path / "half.csv").write_text("mass\n1\n")
    with pytest.raises(ValueError, match="has no column 'speed'"):
        named_point(BOWL, str(tmp_path / "half.csv"))
    with pytest.raises(ValueError, match="a table"):
        named_point(BOWL, str(tmp_path / "missing.csv"))


def test_rows_are_counted_as_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("Mass;Speed;loss\nkg;m/s;\n\n1;0,5;9\nfailed;0,25;1\n2;0,125;8\n")
    assert named_point(BOWL, f"{path}:4").tolist() == [1.0, 0.5]
    assert named_point(BOWL, str(path)).tolist() == [2.0, 0.125]  # of the least loss among those that are points
    with pytest.raises(ValueError, match=r"row 5 of .* has no number in column Mass"):
        named_point(BOWL, f"{path}:5")
    with pytest.raises(ValueError, match=r"rows 4 to 6 \(1 is the heading\); got row 2"):
        named_point(BOWL, f"{path}:2")


def test_a_line_joins_rows_of_a_table() -> None:
    assert points_in("a.csv:1:b.parquet:12") == ["a.csv:1", "b.parquet:12"]
    assert points_in("a.csv:center:random:3") == ["a.csv", "center", "random:3"]
