"""Names of dictionaries, in every place that names one."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from companion.settings.reading import load_settings
from mavlink_sim.camera.scene_file import SceneError, parse_scene
from mavlink_sim.world.fiducials import Print
from tests.companion.command_line import companion_here
from vision.calibration.boards import Board
from vision.marker_dictionaries import DICTIONARIES, dictionary_named
from vision.markers import MarkerKind

NAMES = {
    "APRILTAG_36h11": (
        "DICT_APRILTAG_36h11", "DICT_APRILTAG_36H11", "dict_apriltag_36h11", "APRILTAG_36H11",
        "tag36h11", "TAG36H11", "Tag36h11", "36h11", "36H11", "cv2.aruco.DICT_APRILTAG_36h11", "tag-36h11",
        " tag36h11 ", "apriltag36h11",
    ),
    "APRILTAG_16h5": ("tag16h5", "16h5", "DICT_APRILTAG_16h5"),
    "4X4_50": ("4x4_50", "DICT_4X4_50", "aruco.DICT_4X4_50", "cv::aruco::DICT_4X4_50", "ARUCO_4X4-50"),
    "6X6_250": ("dict_6x6_250", "DICT_6x6_250"),
    "ARUCO_ORIGINAL": ("DICT_ARUCO_ORIGINAL", "aruco_original", "ORIGINAL"),
    "ARUCO_MIP_36h12": ("DICT_ARUCO_MIP_36H12", "aruco_mip_36h12", "MIP_36h12"),
}  # fmt: skip
ALL = [(given, name) for name, spellings in NAMES.items() for given in (name, *spellings)]
WRONG = ("", "tag36h12", "8X8_50", "4X4_51", "tagStandard41h12", "DICT", "apriltag")


@pytest.mark.parametrize(("given", "name"), ALL)
def test_names_of_other_programs_are_read(given: str, name: str) -> None:
    assert dictionary_named(given) == name


@pytest.mark.parametrize("name", [each for each in dir(cv2.aruco) if each.startswith("DICT_")])
def test_every_name_of_opencv_is_its_own_dictionary(name: str) -> None:
    ours = getattr(cv2.aruco, f"DICT_{dictionary_named(name)}")
    assert ours == getattr(cv2.aruco, name)
    assert dictionary_named(name) in DICTIONARIES


@pytest.mark.parametrize("name", WRONG)
def test_wrong_name_lists_the_right_ones(name: str) -> None:
    with pytest.raises(ValueError, match="known: ") as caught:
        dictionary_named(name)
    assert all(each in str(caught.value) for each in DICTIONARIES)


def test_family_on_a_board_is_the_shortest_that_has_its_markers() -> None:
    assert Board("charuco", 10, 7, 0.02, 0.015, "DICT_4X4").dictionary == "4X4_50"
    assert Board("charuco", 14, 9, 0.02, 0.015, "5x5").dictionary == "5X5_100"
    assert Board("charuco", 20, 20, 0.02, 0.015, "6X6").dictionary == "6X6_250"


def test_every_place_that_names_a_dictionary_reads_all_names(tmp_path: Path) -> None:
    given, name = "DICT_APRILTAG_36H11", "APRILTAG_36h11"
    assert MarkerKind(given, 0.5).dictionary == name
    assert Print(given, 3, 0.5).dictionary == name
    assert Board("charuco", 10, 7, 0.02, 0.015, given).dictionary == name
    settings = load_settings(None, {"markers.dictionary": given})
    assert settings.markers.dictionary == name
    scene = parse_scene(f'[[plates]]\ndictionary = "{given}"\nid = 3\nsize_m = 0.5\nplace_m = [1.0, 2.0]\n')
    (plate,) = scene.world.objects
    assert plate.printed is not None
    assert plate.printed.dictionary == name
    words = ("markers", "3", "--dictionary", given, "--size", "0.1", "-o", "markers.pdf")
    assert companion_here(*words, cwd=tmp_path).returncode == 0
    assert name.encode() in (tmp_path / "markers.pdf").read_bytes()


def test_wrong_name_in_a_scene_or_setting_names_its_key(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"plates\[0\].dictionary.*known: "):
        parse_scene('[[plates]]\ndictionary = "8X8"\nid = 3\nsize_m = 0.5\nplace_m = [1.0, 2.0]\n')
    done = companion_here("describe", "settings", "--markers-dictionary", "tag36h12", cwd=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "markers.dictionary" in line
    assert "APRILTAG_36h11" in line
