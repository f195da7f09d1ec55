from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.vision.point_cloud.clouds import random_cloud
from vision.point_cloud import FRAMES, CloudFileError, PointCloud, read_cloud, write_cloud

coordinates = st.floats(-1e6, 1e6, width=32)
points = arrays.arrays(np.float32, st.tuples(st.integers(0, 20), st.just(3)), elements=coordinates)
TWO = PointCloud(
    np.array([[1.0, 2.0, 3.0], [-0.5, 0.25, 0.1]], np.float32),
    np.array([[255, 128, 0], [1, 2, 3]], np.uint8),
    "ned",
    12345,
)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize("binary", [True, False])
@given(points, st.booleans(), st.sampled_from(FRAMES), st.integers(0, 2**62), st.randoms())
@settings(max_examples=30, deadline=None)
def test_files_round_trip_exactly(
    tmp_path_factory: Any,
    suffix: str,
    binary: bool,
    xyz: Any,
    coloured: bool,
    frame: Any,
    stamp: int,
    rng: Any,
) -> None:
    colours = np.array([rng.randrange(256) for _ in range(xyz.size)], np.uint8).reshape(-1, 3)
    cloud = PointCloud(xyz, colours if coloured else None, frame, stamp)
    path = tmp_path_factory.mktemp("cloud") / f"cloud{suffix}"
    write_cloud(path, cloud, binary=binary)
    back = read_cloud(path)
    np.testing.assert_array_equal(back.points, xyz)
    assert (back.frame, back.stamp_ns) == (frame, stamp)
    if coloured:
        np.testing.assert_array_equal(back.colours, colours)
    else:
        assert back.colours is None


def test_binary_ply_has_the_bytes_of_the_format(tmp_path: Path) -> None:
    path = tmp_path / "two.ply"
    write_cloud(path, TWO)
    header, body = path.read_bytes().split(b"end_header\n")
    assert header.decode().split("\n")[:-1] == [
        "ply",
        "format binary_little_endian 1.0",
        "comment frame ned",
        "comment stamp_ns 12345",
        "element vertex 2",
        "property float x",
        "property float y",
        "property float z",
        "property uchar red",
        "property uchar green",
        "property uchar blue",
    ]
    assert body == struct.pack("<3f3B", 1, 2, 3, 255, 128, 0) + struct.pack("<3f3B", -0.5, 0.25, 0.1, 1, 2, 3)


def test_text_ply_has_a_line_for_each_vertex(tmp_path: Path) -> None:
    path = tmp_path / "two.ply"
    write_cloud(path, TWO, binary=False)
    lines = path.read_text().splitlines()
    assert lines[1] == "format ascii 1.0"
    assert lines[-2] == "1 2 3 255 128 0"
    assert [float(word) for word in lines[-1].split()] == pytest.approx([-0.5, 0.25, 0.1, 1, 2, 3])


def test_binary_pcd_has_the_bytes_of_the_format(tmp_path: Path) -> None:
    path = tmp_path / "two.pcd"
    write_cloud(path, TWO)
    header, body = path.read_bytes().split(b"DATA binary\n")
    entries = dict(line.split(" ", 1) for line in header.decode().splitlines() if not line.startswith("#"))
    assert list(entries) == [
        "VERSION",
        "FIELDS",
        "SIZE",
        "TYPE",
        "COUNT",
        "WIDTH",
        "HEIGHT",
        "VIEWPOINT",
        "POINTS",
    ]
    assert (entries["FIELDS"], entries["SIZE"], entries["TYPE"]) == ("x y z rgb", "4 4 4 4", "F F F F")
    assert (entries["WIDTH"], entries["HEIGHT"], entries["POINTS"]) == ("2", "1", "2")
    assert body == struct.pack("<3fI", 1, 2, 3, 0xFF8000) + struct.pack("<3fI", -0.5, 0.25, 0.1, 0x010203)


def test_text_pcd_has_the_colour_as_a_whole_number(tmp_path: Path) -> None:
    path = tmp_path / "two.pcd"
    write_cloud(path, TWO, binary=False)
    lines = path.read_text().splitlines()
    assert "TYPE F F F U" in lines
    assert lines[-2] == f"1 2 3 {0xFF8000}"


def test_files_of_other_programs_are_read(tmp_path: Path) -> None:
    ply = tmp_path / "other.ply"
    ply.write_bytes(
        b"ply\r\nformat binary_little_endian 1.0\r\nobj_info scan\r\nelement vertex 1\r\n"
        b"property double x\r\nproperty double y\r\nproperty double z\r\nproperty float nx\r\n"
        b"property uchar red\r\nproperty uchar green\r\nproperty uchar blue\r\nelement face 1\r\n"
        b"property list uchar int vertex_indices\r\nend_header\r\n"
        + struct.pack("<3df3B", 1.5, 2.5, 3.5, 0.1, 9, 8, 7)
        + struct.pack("<B3i", 3, 0, 0, 0)
    )
    cloud = read_cloud(ply)
    assert cloud.points.tolist() == [[1.5, 2.5, 3.5]]
    assert cloud.colours is not None
    assert cloud.colours.tolist() == [[9, 8, 7]]
    assert (cloud.frame, cloud.stamp_ns) == ("camera", 0)

    pcd = tmp_path / "organised.pcd"
    pcd.write_text(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity rgb\n"
        "SIZE 4 4 4 4 4\nTYPE F F F F F\nCOUNT 1 1 1 1 1\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        "POINTS 2\nDATA ascii\n1 2 3 0.5 4.2108e+06\nnan nan nan 0 0\n"
    )
    cloud = read_cloud(pcd)
    assert cloud.points.tolist() == [[1.0, 2.0, 3.0]]
    padded = tmp_path / "padded.pcd"
    padded.write_bytes(
        b"VERSION .7\nFIELDS x y z _ rgba _\nSIZE 4 4 4 1 4 1\nTYPE F F F U U U\nCOUNT 1 1 1 4 1 12\n"
        b"WIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA binary\n" + struct.pack("<3f4xI12x", 1, 2, 3, 0xFF0A0B0C)
    )
    cloud = read_cloud(padded)
    assert cloud.points.tolist() == [[1.0, 2.0, 3.0]]
    assert cloud.colours is not None
    assert cloud.colours.tolist() == [[10, 11, 12]]


@given(st.binary(max_size=200), st.sampled_from([".ply", ".pcd"]), st.integers(0, 400))
@settings(max_examples=150, deadline=None)
def test_damaged_files_give_one_error(tmp_path_factory: Any, junk: bytes, suffix: str, at: int) -> None:
    path = tmp_path_factory.mktemp("damaged") / f"cloud{suffix}"
    write_cloud(path, random_cloud(1, 5))
    data = path.read_bytes()
    path.write_bytes(data[:at] + junk + data[at + len(junk) :])
    try:
        cloud = read_cloud(path)
    except CloudFileError:
        return
    assert cloud.points.shape[1] == 3
