from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `train`")

from training import pairs as pairs_module
from training.corpus import Picture, load_corpus
from training.pairs import Pairs, transfer
from training.scenes import View


def gray_at(image: np.ndarray, xy: np.ndarray) -> np.ndarray:
    columns, rows = xy.astype(np.float32).T[:, :, None]
    return cv2.remap(image.astype(np.float32), columns, rows, cv2.INTER_LINEAR)[:, 0]


def test_a_transferred_point_shows_the_same_in_both_views(corpus: Path) -> None:
    _, (views,) = load_corpus(corpus)
    first, second = views[:2]
    rng = np.random.default_rng(0)
    xy = rng.uniform(5, (506, 378), (3000, 2))
    there, visible = transfer(first, second, xy)
    assert visible.sum() > 300
    assert np.linalg.norm(there - xy, axis=1)[visible].mean() > 20  # there is parallax
    smooth = [cv2.GaussianBlur(view.image, (0, 0), 2.0) for view in (first, second)]
    difference = gray_at(smooth[0], xy[visible]) - gray_at(smooth[1], there[visible])
    chance = gray_at(smooth[0], xy[visible]) - gray_at(smooth[1], rng.permutation(there[visible]))
    assert np.median(np.abs(difference)) < 0.15 * np.median(np.abs(chance))


def test_a_hidden_point_is_not_transferred(views: list[View]) -> None:
    first, second = views[:2]
    nearer = Picture(
        second.image,
        np.zeros((1, 1, 192), np.int8),
        np.zeros((0, 2), np.float32),
        second.depth * 0.8,  # a pane before everything
        second.cam_from_world,
    )
    farther = Picture(*list(vars(nearer).values())[:3], first.depth, first.cam_from_world)
    _, visible = transfer(farther, nearer, np.random.default_rng(0).uniform(5, 370, (500, 2)))
    assert not visible.any()


@pytest.mark.parametrize("rendered_share", [0.0, 1.0])
def test_the_points_of_a_pair_see_the_same_thing(
    corpus: Path, monkeypatch: pytest.MonkeyPatch, rendered_share: float
) -> None:
    monkeypatch.setattr(pairs_module, "RENDERED_SHARE", rendered_share)
    monkeypatch.setattr(pairs_module, "spoil", lambda image, rng: image)
    batch = Pairs(corpus, 6, seed=1)[0]
    differences, chances = [], []
    rng = np.random.default_rng(0)
    for b in range(6):
        valid = batch.valid[b].numpy()
        grays = [
            gray_at(
                cv2.GaussianBlur(batch.images[6 * side + b, 0].numpy(), (0, 0), 2.0),
                batch.points[side, b].numpy()[valid],
            )
            for side in range(2)
        ]
        differences.append(np.abs(grays[0] - grays[1]))
        chances.append(np.abs(grays[0] - rng.permutation(grays[1])))
    medians = np.median(np.concatenate(differences)), np.median(np.concatenate(chances))
    assert medians[0] < 0.25 * medians[1]


def test_a_batch_is_a_function_of_seed_and_step(corpus: Path) -> None:
    again = [vars(Pairs(corpus, 2, seed=4)[7]) for _ in range(2)]
    assert all(torch.equal(again[0][name], again[1][name]) for name in again[0])
    other = Pairs(corpus, 2, seed=5)[7]
    assert not torch.equal(again[0]["images"], other.images)


def test_keypoints_are_drawn_at_their_sub_pixel_place() -> None:
    places = np.array([[30.3, 40.0], [99.5, 70.75]])
    heat = pairs_module._heat(places).astype(np.float64)
    for x, y in places:
        column, row = round(x), round(y)
        patch = np.log(np.maximum(heat[row - 1 : row + 2, column - 1 : column + 2], 1))
        offset = 0.5 * (patch[1, 2] - patch[1, 0]) / (2 * patch[1, 1] - patch[1, 0] - patch[1, 2])
        assert column + offset == pytest.approx(x, abs=0.05)
