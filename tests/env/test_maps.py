"""Maps from files: the world has what the file says, and bad files are refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from env_support import MAP
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from PIL import Image

from d4orm_env import load_map, make_problem
from d4orm_env.scenarios import load_problem, save_problem
from d4orm_env.scenarios.grid_map import GridMap, merge_cells

BLOCKED = arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=12))


def text_of(blocked: Any, free: str = ".", closed: str = "@") -> str:
    rows = "\n".join("".join(closed if cell else free for cell in row) for row in blocked)
    return f"type octile\nheight {len(blocked)}\nwidth {len(blocked[0])}\nmap\n{rows}\n"


def written(folder: Path, content: str | bytes, name: str = "grid.map") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@given(BLOCKED)
def test_boxes_cover_the_blocked_cells_once_and_nothing_else(blocked: np.ndarray) -> None:
    covered = np.zeros(blocked.shape, int)
    for top, left, bottom, right in merge_cells(blocked):
        assert top < bottom
        assert left < right
        covered[top:bottom, left:right] += 1
    np.testing.assert_array_equal(covered, blocked)


@given(BLOCKED.filter(lambda blocked: not blocked.all()), st.sampled_from([0.25, 0.6, 3.0]))
def test_the_world_is_blocked_where_the_map_is(blocked: np.ndarray, cell: float) -> None:
    grid = GridMap(blocked, cell, (-1.5, 2.0))
    rows, columns = blocked.shape
    row, column = np.indices(blocked.shape)
    centres = np.stack([-1.5 + (column + 0.5) * cell, 2.0 + (rows - row - 0.5) * cell], axis=-1)
    np.testing.assert_array_equal(grid.world.clearance(centres) < 0, blocked)
    assert np.abs(grid.world.clearance(centres)).min() > 0.499 * cell
    np.testing.assert_allclose(grid.world.bounds, [[-1.5, 2.0], [-1.5 + columns * cell, 2.0 + rows * cell]], rtol=1e-6)
    cells = np.stack([column.ravel(), row.ravel()], axis=1)
    np.testing.assert_allclose(grid.centres(cells), centres.reshape(-1, 2))


def test_few_boxes() -> None:
    frame = np.ones((50, 70), bool)
    frame[1:-1, 1:-1] = False
    assert len(merge_cells(frame)) == 4
    stripes = np.zeros((40, 40), bool)
    stripes[:, ::2] = True
    assert len(merge_cells(stripes)) == len(merge_cells(stripes.T)) == 20


@pytest.mark.parametrize(("free", "closed"), [(".", "@"), ("G", "O"), ("S", "T"), (".", "W"), ("E", "@")])
def test_moving_ai_characters(tmp_path: Path, free: str, closed: str) -> None:
    path = written(tmp_path, text_of([[1, 0, 0], [0, 0, 0]], free, closed))
    world = load_map(path, cell=2.0)
    assert world.boxes.tolist() == [[0, 2, 2, 4]]  # the first row is at the top
    assert world.bounds.tolist() == [[0, 0], [6, 4]]


def test_line_ends_and_the_order_of_the_header_do_not_matter(tmp_path: Path) -> None:
    plain = text_of([[1, 0], [0, 0]])
    first = load_map(written(tmp_path, plain))
    dos = load_map(written(tmp_path, plain.replace("\n", "\r\n"), "dos.map"))
    other = load_map(written(tmp_path, "width 2\nheight\t2\ntype tile\nmap\n@.\n..\n\n\n", "other.map"))
    marked = load_map(written(tmp_path, b"\xef\xbb\xbf" + plain.encode(), "marked.map"))
    for world in (dos, other, marked):
        assert world.boxes.tolist() == first.boxes.tolist()


def test_a_free_cell_is_a_world(tmp_path: Path) -> None:
    world = load_map(written(tmp_path, text_of([[0]])))
    assert world.num_obstacles == 0
    np.testing.assert_allclose(world.bounds, [[0, 0], [0.6, 0.6]], rtol=1e-6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is not a Moving AI map; it must begin with lines 'type octile'"),
        ("hello\n", "is not a Moving AI map"),
        (b"\x89PNG\r\n\x1a\n\0\0", "is not a Moving AI map"),
        ("type octile\nheight 2\nwidth 2\n", "is not a Moving AI map"),
        ("type octile\nheight 2\nheight 2\nmap\n..\n..\n", "is not a Moving AI map"),
        ("type octile\nheight two\nwidth 2\nmap\n..\n..\n", "has 'two' as its height; it must be a whole number"),
        ("type octile\nheight 0\nwidth 2\nmap\n", "has '0' as its height"),
        ("type octile\nheight -1\nwidth 2\nmap\n", "has '-1' as its height"),
        ("type octile\nheight 99999\nwidth 99999\nmap\n", "has 99999 x 99999 cells; at most 16777216 are read"),
        ("type octile\nheight 3\nwidth 2\nmap\n..\n..\n", "has 2 rows of cells where its height is 3"),
        ("type octile\nheight 2\nwidth 2\nmap\n..\n...\n", "has 3 cells in line 6 where its width is 2"),
        ("type octile\nheight 2\nwidth 2\nmap\n..\n.x\n", "has 'x' in line 6, column 2; cells are . G S E \\(free\\)"),
        (text_of([[1]]), "has no free cell"),
        (text_of([[1, 1], [1, 1]]), "has no free cell; open some"),
        (text_of([[0] * 200_000]), r"has 1 x 200000 cells of 0.6 m \(resolution or cell\)"),
    ],
)
def test_bad_maps_are_refused_in_one_line(tmp_path: Path, content: str | bytes, message: str) -> None:
    path = written(tmp_path, content)
    with pytest.raises(ValueError, match=message) as error:
        load_map(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    for path, message in (
        (tmp_path / "no.map", "cannot be read"),
        (tmp_path, "is not a file"),
        (3, "must be text or a"),
    ):
        with pytest.raises(ValueError, match=message):
            load_map(path)  # type: ignore[arg-type]
    with pytest.raises(FileNotFoundError, match=r"no\.map: cannot be read"):
        load_map(tmp_path / "no.map")
    for cell in (0, -1, float("nan"), "wide", 1e9):
        with pytest.raises(ValueError, match="cell"):
            load_map(MAP, cell=cell)  # type: ignore[arg-type]


def test_a_million_cells(tmp_path: Path) -> None:
    blocked = np.random.default_rng(0).random((1000, 1000)) < 0.2
    path = written(tmp_path, text_of(blocked))
    world = load_map(path)  # which would take hours if each cell were compared with the others
    assert 600**2 * 0.19 < np.prod(world.boxes[:, 2:] - world.boxes[:, :2], axis=1).sum() < 600**2 * 0.21


SHADES = np.array([[0, 205, 254], [254, 254, 254]], np.uint8)
KEYED = np.array([[250, 254]], np.uint8)
TRANSPARENT: dict[str, tuple[Image.Image, Any]] = {
    "LA": (Image.fromarray(np.array([[[255, 0], [255, 255]]], np.uint8)), None),
    "RGBA": (Image.fromarray(np.array([[[255, 255, 255, 0], [255, 255, 255, 255]]], np.uint8)), None),
    "shade": (Image.fromarray(KEYED), 250),
    "deep shade": (Image.fromarray(KEYED.astype(np.uint16) * 257), 250 * 257),
    "colour": (Image.fromarray(np.repeat(KEYED[..., None], 3, axis=2)), (250, 250, 250)),
    "palette": (Image.fromarray(KEYED).convert("P"), 250),
    "palette with a table": (Image.fromarray(KEYED).convert("P"), bytes([255] * 250 + [0, 255, 255, 255, 255, 255])),
}
"""Images of two pixels of the colour of free ground, the left one transparent, and the PNG chunk that says so."""
FIELDS = "image: {}\nresolution: 0.5\norigin: [-1, 2, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


class TestOccupancyImage:
    @pytest.mark.parametrize("name", ["map.png", "map.pgm"])
    def test_what_is_not_known_to_be_free_is_blocked(self, tmp_path: Path, name: str) -> None:
        Image.fromarray(SHADES).save(tmp_path / name)
        world = load_map(written(tmp_path, FIELDS.format(name), "map.yaml"))
        assert world.boxes.tolist() == [[-1, 2.5, 0, 3]]
        assert world.bounds.tolist() == [[-1, 2], [0.5, 3]]

    def test_an_image_alone_needs_its_resolution(self, tmp_path: Path) -> None:
        image = tmp_path / "floor.png"
        Image.fromarray(np.array([[0, 255], [255, 255]], np.uint8)).save(image)
        world = load_map(image, resolution=0.5)
        np.testing.assert_allclose(world.boxes, [[0, 0.5, 0.5, 1]])
        assert load_map(image, resolution=0.5).upper.tolist() == [1, 1]  # type: ignore[union-attr]
        with pytest.raises(
            ValueError, match=r"floor.png: is an image without its map_server YAML file; give resolution="
        ):
            load_map(image)
        grid = tmp_path / "floor.map"
        grid.write_text("type octile\nheight 1\nwidth 1\nmap\n.\n")
        with pytest.raises(ValueError, match="only these take a resolution; leave it out, or convert"):
            load_map(grid, resolution=0.5)

    def test_negated_coloured_and_deep_images(self, tmp_path: Path) -> None:
        Image.fromarray(255 - SHADES).save(tmp_path / "map.png")
        path = written(tmp_path, FIELDS.format("map.png").replace("negate: 0", "negate: 1"), "map.yaml")
        assert load_map(path).boxes.tolist() == [[-1, 2.5, 0, 3]]
        path = written(tmp_path, FIELDS.format("map.png"), "map.yaml")
        Image.fromarray(np.repeat(SHADES[..., None], 4, axis=2)).save(tmp_path / "map.png")
        assert load_map(path).boxes.tolist() == [[-1, 2.5, 0, 3]]
        Image.fromarray(SHADES.astype(np.uint16) * 257).save(tmp_path / "map.png")
        assert load_map(path).boxes.tolist() == [[-1, 2.5, 0, 3]]

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (("origin: [-1, 2, 0]", "origin: [-1, 2, 0.3]"), "has a yaw of 0.3 rad; only maps with a yaw of 0"),
            (("origin: [-1, 2, 0]", "origin: [-1, 2]"), "it must be three numbers, x, y and yaw"),
            (("origin: [-1, 2, 0]", ""), "has no field 'origin'"),
            (("origin: [-1, 2, 0]", "origin: [-1, -nan, 0]"), "it must be three numbers, x, y and yaw"),
            (
                ("origin: [-1, 2, 0]", "origin: [-1, 2e9, 0]"),
                r"origin\[1\] is 2e\+09; magnitudes must be at most 1e\+09",
            ),
            (("resolution: 0.5", "resolution: 0.00000001"), "resolution is 1e-08; it must be at least 1e-07"),
            (("resolution: 0.5", "resolution: 20000"), "has 80 x 120 cells of 20000 m"),
            (("resolution: 0.5", "resolution: 0"), "resolution is 0"),
            (("resolution: 0.5", "resolution: fine"), "resolution must be a number"),
            (("negate: 0", "negate: 2"), "negate is 2; it must be 0 or 1"),
            (("negate: 0", "mode: rough"), "mode is 'rough'; it must be one of trinary, scale, raw"),
            (("negate: 0", "mode: 3"), "mode is 3; it must be one of trinary, scale, raw"),
            (("negate: 0", "negate: 1\nmode: raw"), "negate is 1 and mode is raw"),
            (("free_thresh: 0.196", "free_thresh: 0.9"), "free_thresh is 0.9; it must be at most occupied_thresh"),
            (("free_thresh: 0.196", "free_thresh: 0"), "has no free cell"),
            (("image: map.png", "image: 3"), "image is 3; it must be the path"),
            (("image: map.png", "image: none.png"), "none.png: cannot be read"),
            (("image: map.png", "image: text.png"), "its image is no image that can be read"),
            (("image: map.png", "image: cut.png"), "its image is broken"),
        ],
    )
    def test_bad_files_are_refused_in_one_line(self, tmp_path: Path, change: tuple[str, str], message: str) -> None:
        Image.fromarray(np.tile(SHADES, (40, 40))).save(tmp_path / "map.png")
        written(tmp_path, "hello", "text.png")
        written(tmp_path, (tmp_path / "map.png").read_bytes()[:-40], "cut.png")
        path = written(tmp_path, FIELDS.format("map.png").replace(*change), "map.yaml")
        with pytest.raises(ValueError, match=message) as error:
            load_map(path)
        assert "\n" not in str(error.value)
        assert str(tmp_path) in str(error.value)

    @pytest.mark.parametrize("mode", ["trinary", "scale"])
    @pytest.mark.parametrize("kind", TRANSPARENT)
    def test_transparent_pixels_are_blocked(self, tmp_path: Path, kind: str, mode: str) -> None:
        image, key = TRANSPARENT[kind]
        image.save(tmp_path / "map.png", transparency=key)
        fields = FIELDS.format("map.png") + f"mode: {mode}\n"
        assert load_map(written(tmp_path, fields, "map.yaml")).boxes.tolist() == [[-1, 2, -0.5, 2.5]]

    def test_transparency_frees_nothing(self, tmp_path: Path) -> None:
        Image.fromarray(np.array([[[0, 0], [0, 255]]], np.uint8)).save(tmp_path / "map.png")  # LA
        for mode in ("trinary", "scale"):  # black is free, and transparent black is not
            fields = FIELDS.format("map.png").replace("negate: 0", f"negate: 1\nmode: {mode}")
            assert load_map(written(tmp_path, fields, "map.yaml")).boxes.tolist() == [[-1, 2, -0.5, 2.5]]
        Image.new("1", (2, 2), 1).save(tmp_path / "map.png", transparency=255)
        with pytest.raises(ValueError, match="has no free cell"):
            load_map(written(tmp_path, FIELDS.format("map.png"), "map.yaml"))

    @pytest.mark.parametrize(
        ("mode", "shades", "free"),
        [
            # As map_server: (3 * shade + alpha) / 4 of 255 leaves less than 0.196 to one.
            ("trinary", [(255, 55), (255, 56), (220, 160), (220, 161)], [0, 1, 0, 1]),
            # An unknown grey stays unknown in an image that has an alpha channel.
            ("trinary", [(205, 255), (206, 255), (254, 255), (255, 0)], [0, 1, 1, 0]),
            ("scale", [(255, 254), (255, 255), (205, 255), (0, 255)], [0, 1, 0, 0]),
            ("raw", [(0, 255), (19, 255), (20, 255), (255, 255)], [1, 1, 0, 0]),
            ("raw", [(0, 254), (0, 0), (100, 255), (1, 255)], [0, 0, 0, 1]),
        ],
    )
    def test_each_mode_reads_alpha_as_map_server_does(
        self, tmp_path: Path, mode: str, shades: list[tuple[int, int]], free: list[int]
    ) -> None:
        Image.fromarray(np.array([shades], np.uint8)).save(tmp_path / "map.png")
        world = load_map(written(tmp_path, FIELDS.format("map.png") + f"mode: {mode}\n", "map.yaml"))
        centres = [[-1 + 0.5 * column + 0.25, 2.25] for column in range(4)]
        assert (world.clearance(centres) > 0).tolist() == [bool(value) for value in free]

    @pytest.mark.parametrize("name", ["map.YAML", "map.Yml", "map.yaml"])
    @pytest.mark.parametrize("mode", ["Trinary", "SCALE", "trinary"])
    def test_names_in_letters_of_either_case(self, tmp_path: Path, name: str, mode: str) -> None:
        Image.fromarray(SHADES).save(tmp_path / "map.png")
        path = written(tmp_path, FIELDS.format("map.png") + f"mode: {mode}\n", name)
        assert load_map(path).boxes.tolist() == [[-1, 2.5, 0, 3]]

    @pytest.mark.parametrize("yaw", ["1e-9", "-1e-9", "6.283185307", "0.0", "-nan", "nan", ".nan", "-.NaN"])
    def test_a_yaw_that_turns_nothing_is_none(self, tmp_path: Path, yaw: str) -> None:
        Image.fromarray(SHADES).save(tmp_path / "map.png")
        path = written(tmp_path, FIELDS.format("map.png").replace("2, 0]", f"2, {yaw}]"), "map.yaml")
        assert load_map(path).boxes.tolist() == [[-1, 2.5, 0, 3]]

    def test_an_origin_far_out_is_kept_beside_the_world(self, tmp_path: Path) -> None:
        Image.fromarray(np.pad(np.full((30, 40), 254, np.uint8), 1)).save(tmp_path / "map.png")
        fields = FIELDS.format("map.png").replace("0.5", "0.1").replace("[-1, 2, 0]", "[500000.25, 5410000.125, 0]")
        path = written(tmp_path, fields, "map.yaml")
        near = load_map(written(tmp_path, fields.replace("[500000.25, 5410000.125, 0]", "[0, 0, 0]"), "near.yaml"))
        assert load_map(path).origin.tolist() == [500000.25, 5410000.125]
        assert near.origin.tolist() == [0, 0]
        np.testing.assert_array_equal(load_map(path).boxes, near.boxes)
        problem = make_problem("map", 2, map=path)
        assert problem.origin.tolist() == [500000.25, 5410000.125]
        assert problem != make_problem("map", 2, map=tmp_path / "near.yaml")
        save_problem(problem, tmp_path / "saved.yaml")
        assert load_problem(tmp_path / "saved.yaml") == problem
        assert load_problem(tmp_path / "saved.yaml").origin.tolist() == [500000.25, 5410000.125]

    def test_other_yaml_is_refused(self, tmp_path: Path) -> None:
        for content in ("- 1\n", "hello\n", "version: 1\nscenario: circle\n"):
            with pytest.raises(ValueError, match=r"map_server file"):
                load_map(written(tmp_path, content, "map.yaml"))


class TestMapScenario:
    def test_positions_are_free_and_connected(self, tmp_path: Path) -> None:
        # Two halves, of which the right one is larger, and a passage too narrow for anyone.
        blocked = np.zeros((20, 30), int)
        blocked[:, 10] = 1
        path = written(tmp_path, text_of(blocked))
        problem = make_problem("map", 10, map=path)
        assert (problem.start[:, 0] > 6.6).all()
        assert (problem.goal[:, 0] > 6.6).all()

    def test_paths_one_cell_wide_are_paths(self, tmp_path: Path) -> None:
        blocked = np.ones((5, 9), int)
        blocked[1:4, 1:3] = blocked[1:4, 6:8] = blocked[2, 1:8] = 0
        path = written(tmp_path, text_of(blocked))
        for cell in (0.42, 0.6, 1.0):
            problem = make_problem("map", 1, map=path, cell=cell)
            assert problem.horizon >= 100
        sides = {make_problem("map", 1, seed, map=path).start[0, 0] > 2.7 for seed in range(20)}
        assert sides == {True, False}

    def test_draws_anew_but_keeps_the_world(self) -> None:
        first, second = (make_problem("map", 5, seed, map=MAP) for seed in (0, 1))
        assert first.world is second.world
        assert first.horizon == second.horizon
        assert first != second

    def test_a_file_that_changed_is_read_again(self, tmp_path: Path) -> None:
        path = written(tmp_path, text_of(np.zeros((6, 6), int)))
        assert make_problem("map", 2, map=path).world.num_obstacles == 0
        written(tmp_path, text_of(np.eye(6, dtype=int)[::-1] * (np.arange(6) == 2)))
        assert make_problem("map", 2, map=path).world.num_obstacles == 1
        assert load_map(path, 0.6) is load_map(path, 0.6)
        assert load_map(path, 0.5) is not load_map(path, 0.6)

    @pytest.mark.parametrize(
        ("blocked", "arguments", "message"),
        [
            (
                [[0]],
                {},
                "only . of 16 starts and goals .* use fewer robots, a larger map, larger cells or smaller robots",
            ),
            ([[0] * 9], {"radius": 5}, "only 0 of 16 starts and goals"),
            ([[0] * 9], {"cell": 1e-3}, "only 0 of 16 starts and goals"),
            ([[0] * 9], {"cell": 9999.0, "radius": 0.01}, r"starts and goals|float32|needs"),
            ([[0] * 9], {"model": "holonomic3d"}, "is planar"),
        ],
    )
    def test_robots_that_do_not_fit(
        self, tmp_path: Path, blocked: Any, arguments: dict[str, Any], message: str
    ) -> None:
        with pytest.raises(ValueError, match=message) as error:
            make_problem("map", map=written(tmp_path, text_of(blocked)), **arguments)
        assert "\n" not in str(error.value)

    def test_it_needs_a_map(self) -> None:
        with pytest.raises(ValueError, match=r"needs map=, the path of a \.map file, of a map_server \.yaml file, or"):
            make_problem("map")

    def test_scenario_files_name_no_map(self, tmp_path: Path) -> None:
        path = written(tmp_path, f"version: 1\nscenario: map\nmap: {MAP}\n", "team.yaml")
        with pytest.raises(ValueError, match="scenario 'map' reads another file"):
            load_problem(path)


ROW = "0\tgrid.map\t4\t3\t{}\t{}\t{}\t{}\t3.5\n"


class TestMovingAiScenario:
    @pytest.fixture
    def grid(self, tmp_path: Path) -> Path:
        return written(tmp_path, text_of([[0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]]))

    def test_rows_say_from_where_to_where(self, tmp_path: Path, grid: Path) -> None:
        rows = "version 1\n" + ROW.format(0, 0, 3, 2) + ROW.format(3, 0, 0, 2) + ROW.format(1, 1, 1, 1)
        path = written(tmp_path, rows, "grid.scen")
        problem, other = (make_problem("map", 2, seed, map=grid, cell=2.0, scenario_file=path) for seed in (0, 1))
        assert problem.start[:, :2].tolist() == [[1, 5], [7, 5]]
        assert problem.goal.tolist() == [[7, 1], [1, 1]]
        assert problem == other
        crowded = make_problem("map", 2, map=grid, cell=2.0, scenario_file=path, num_obstacles=1)
        assert crowded.world.num_obstacles == 2
        assert crowded.replace(world=None) == problem.replace(world=None)

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ("", "is not a Moving AI scenario; it must begin with a line 'version 1'"),
            ("version 1\n", "has 0 rows for 1 robots; use another file"),
            ("version 1\n" + ROW.format(1, 1, 0, 0), r"has a start at \(1, 1\) in line 2, a blocked cell"),
            (
                "version 1\n" + ROW.format(0, 0, 1, 1),
                r"has a goal at \(1, 1\) in line 2, a blocked cell; give the file that",
            ),
            ("version 1\n" + ROW.format(0, 0, 4, 0), r"names the cell \(4, 0\) in line 2, which is not on the map"),
            ("version 1\n" + ROW.format(0, 0, -1, 0), "which is not on the map; correct it"),
            ("version 1\n" + ROW.format(0, 0, "x", 0), "has a line 2 that is not bucket, map, width, height"),
            ("version 1\n1 2 3\n", "has a line 2 that is not bucket"),
            (
                "version 1\n" + ROW.format(0, 0, 1, 0) + ROW.format(0, 0, 2, 0),
                "starts of robot_0 .* and robot_1 .* overlap",
            ),
            ("version 1\n" + ROW.format(0, 0, 1, 0).replace("3.5", "nan"), "gives a length of nan in line 2"),
            (
                "version 1\n" + ROW.format(0, 0, 1, 0).replace("\t4\t3", "\t8\t3"),
                "is for a map of width 8 and height 3",
            ),
        ],
    )
    def test_bad_files_are_refused_in_one_line(self, tmp_path: Path, grid: Path, content: str, message: str) -> None:
        path = written(tmp_path, content, "grid.scen")
        with pytest.raises(ValueError, match=message) as error:
            make_problem("map", max(content.count("grid.map"), 1), map=grid, scenario_file=path)
        assert str(error.value).startswith(f"{path}: ")
        assert "\n" not in str(error.value)

    def test_robots_must_fit_where_they_begin(self, tmp_path: Path, grid: Path) -> None:
        path = written(tmp_path, "version 1\n" + ROW.format(0, 0, 3, 2), "grid.scen")
        with pytest.raises(ValueError, match=r"in line 2, which robots of radius 0.4 m .* do not get to; use larger"):
            make_problem("map", 1, map=grid, scenario_file=path, radius=0.4)
        with pytest.raises(ValueError, match="cannot be read"):
            make_problem("map", 1, map=grid, scenario_file=tmp_path / "none.scen")
