"""Retrieval: which of the images that are found see what the query sees (the paper's figure)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import hypergeom

from trigpoint.camera import Camera
from trigpoint.database.ranking import POOL, choose_diverse, find_largest
from trigpoint.database.reader import MapReader
from trigpoint.frame import Anchor, quantize_descriptors
from trigpoint.models.features import FeatureModel
from trigpoint.models.retrieval import RetrievalModel
from trigpoint.models.session import hash_files
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint_db.build import read_frame
from trigpoint_db.demo import render_images
from trigpoint_db.experiments.sets import choose, open_map
from trigpoint_db.experiments.store import Store
from trigpoint_db.experiments.tables import markdown
from trigpoint_db.experiments.visibility import MAX_PARALLAX_DEG, MIN_OVERLAP, find_overlapping
from trigpoint_db.figures import make_figure, save_figure
from trigpoint_db.importers.base import Dataset
from trigpoint_db.synthetic import World, flight_poses, make_room, render, survey_poses
from trigpoint_db.terminal import track

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

Array32 = NDArray[np.float32]
Indices = NDArray[np.intp]
Truth = NDArray[np.bool_]
Describe = Callable[[NDArray[np.uint8]], Array32]

RANKS = (1, 5, 10, 20)
NUM_BINS = 10
MIN_LACK_PERCENT = 1.0  # of the places; of less, a verdict would be noise
TINY_PX = 16

PACKAGED = "packaged descriptor"
DIVERSE = "packaged, as the localizer chooses"
TINY = "tiny images"
POSSIBLE = "most possible"
CHANCE = "at random"

ROOM = "rendered room"
ROOM_SEED = 0
SHOWN_ROWS, SHOWN_COLUMNS = 4, 5
THUMBNAIL = Camera("PINHOLE", 96, 72, (69.0, 69.0, 47.5, 35.5))


def measure(
    sets: Mapping[str, Dataset],
    model: FeatureModel,
    external: RetrievalModel | None,
    num_anchors: int,
    num_queries: int,
    store: Store,
    *,
    num_survey: int = 140,
    num_flight: int = 24,
) -> dict[str, Any]:
    """Rank the images of maps by their likeness to queries, in several ways.

    Parameters
    ----------
    sets : mapping of str to Dataset
        Their queries have true poses. The rendered room joins them.
    model : FeatureModel
        Gives the packaged descriptor.
    external : RetrievalModel, optional
        Gives another one to compare with; tiny images do so in any case.
    num_anchors : int
        How many images are retrieved.
    num_queries : int
        Of each set, at the most.
    store : Store
    num_survey, num_flight : int
        Mapped images of the rendered room, and queries there.
    """
    others: dict[str, Describe] = {TINY: describe_tiny}
    if external is not None:
        others[external.contract.name] = external.describe
    identity = None if external is None else hash_files(external.network.path)
    settings = {
        "model": model.identity.sha256,
        "external": identity,
        "num_anchors": num_anchors,
        "num_queries": num_queries,
        "sets": {name: len(dataset.queries) for name, dataset in sets.items()},
        "room": [num_survey, num_flight],
    }
    store.begin("recall", settings)
    names = [*sets, ROOM]
    for name in names:
        if name in store:
            continue
        if name in sets:
            dataset = sets[name]
        else:
            dataset = _render_room(store.folder / "room", num_survey, num_flight)
        chosen = choose(range(len(dataset.queries)), num_queries)
        with open_map(store.folder / "maps", name, dataset, model) as reader:
            store[name] = _measure_set(name, dataset, chosen, reader, model, others, num_anchors)
    return {
        "model": model.identity.name,
        "num_anchors": num_anchors,
        "num_queries": num_queries,
        "sets": {name: store[name] for name in names},
    }


def describe_tiny(image: NDArray[np.uint8]) -> Array32:
    """Describe a gray image by itself, made very small (Torralba, Fergus and Freeman, 2008)."""
    small = cv2.resize(image, (TINY_PX, TINY_PX), interpolation=cv2.INTER_AREA)
    levels = small.ravel().astype(np.float32)
    levels -= levels.mean()
    described: Array32 = levels / max(float(np.linalg.norm(levels)), 1e-6)
    return described


def _render_room(folder: Path, num_survey: int, num_flight: int) -> Dataset:
    """Render a survey of a room to map and a flight through it to query."""
    world = make_room(ROOM_SEED)
    survey = survey_poses(world, num_survey, ROOM_SEED)
    flight = flight_poses(world, num_flight, ROOM_SEED)
    poses = Rigid3(np.concatenate([survey.R, flight.R]), np.concatenate([survey.t, flight.t]))
    rendered = render_images(ROOM_SEED, poses, folder, noise_seed=1000)
    images = list(track(rendered, f"{ROOM}: rendering", len(poses)))
    return Dataset.from_split(folder, images[:num_survey], images[num_survey:])


def _measure_set(
    name: str,
    dataset: Dataset,
    chosen: Sequence[int],
    reader: MapReader,
    model: FeatureModel,
    others: Mapping[str, Describe],
    num_anchors: int,
) -> dict[str, Any]:
    """Rank the images of a map for the chosen queries, and count those that see the same."""
    asked: dict[str, list[Array32]] = {method: [] for method in (PACKAGED, *others)}
    queries = []
    for place in track(chosen, f"{name}: queries", len(chosen)):
        query = dataset.queries[place]
        image = read_frame(dataset.images, query.name, query.camera).image
        features = model.extract(image)
        asked[PACKAGED].append(features.global_descriptor)
        for method, describe in others.items():
            asked[method].append(describe(image))
        true_pose, codes = dataset.truth[query.name], quantize_descriptors(features.descriptors)
        queries.append(Anchor(query.name, query.camera, true_pose, features.keypoints, codes))
    is_correct = find_overlapping(queries, reader, model.long_side_px)

    mapped = {
        PACKAGED: [reader.features(index).global_descriptor for index in range(len(reader))],
        **{
            method: [
                describe(read_frame(dataset.images, image.name, image.camera).image)
                for image in dataset.mapped
            ]
            for method, describe in others.items()
        },
    }
    orders = {
        method: _rank(np.stack(asked[method]), np.stack(mapped[method]), num_anchors)
        for method in asked
    }
    orders[DIVERSE] = _rank(
        np.stack(asked[PACKAGED]),
        np.stack(mapped[PACKAGED]),
        num_anchors,
        LocalizerOptions().anchor_diversity,
    )
    shown = int(np.argmax(is_correct.sum(axis=1)))
    images = orders[PACKAGED][shown]
    return {
        "num_mapped": len(reader),
        "num_queries": len(queries),
        "methods": {
            POSSIBLE: _describe_best(is_correct, num_anchors),
            **{
                method: _describe_order(orders[method], is_correct, num_anchors)
                for method in sorted(orders)
            },
            CHANCE: _describe_chance(is_correct, num_anchors),
        },
        "shown": {
            "query": chosen[shown],
            "of": len(dataset.queries),
            "images": images.tolist(),
            "is_correct": is_correct[shown, images].tolist(),
        },
    }


def _rank(queries: Array32, images: Array32, k: int, diversity: float = 0.0) -> Indices:
    """Return for queries (Q, G) which k of the images (N, G) are most alike, best first."""
    orders = []
    for similarities in queries @ images.T:
        pool = find_largest(similarities, POOL * k)
        alike = images[pool] @ images[pool].T
        orders.append(pool[choose_diverse(similarities[pool], alike, k, diversity)])
    return np.stack(orders)


def _list_ranks(num_anchors: int) -> list[int]:
    """List the ranks that so many images have."""
    return [rank for rank in RANKS if rank <= num_anchors]


def _describe_order(order: Indices, is_correct: Truth, num_anchors: int) -> dict[str, Any]:
    """Describe orders (Q, k) of images: how often one of the first is correct, how many are."""
    found = np.take_along_axis(is_correct, order, axis=1)
    ranks = _list_ranks(num_anchors)
    shares = found.mean(axis=1)
    return {
        "recalls": [float(found[:, :rank].any(axis=1).mean()) for rank in ranks],
        "share": float(shares.mean()),
        "histogram": np.histogram(shares, NUM_BINS, (0, 1))[0].tolist(),
    }


def _describe_best(is_correct: Truth, k: int) -> dict[str, Any]:
    """Describe what an order could have at best, with the correct images that the map has."""
    best = np.argsort(~is_correct, axis=1, kind="stable")[:, :k]
    return _describe_order(best, is_correct, k)


def _describe_chance(is_correct: Truth, k: int) -> dict[str, Any]:
    """Describe what to expect of images drawn at random."""
    num_images, num_correct = is_correct.shape[1], is_correct.sum(axis=1)
    none = [
        hypergeom.pmf(0, num_images, num_correct, min(rank, num_images)) for rank in _list_ranks(k)
    ]
    return {"recalls": [float(1 - p.mean()) for p in none], "share": float(is_correct.mean())}


def write_table(result: Mapping[str, Any]) -> str:
    """Write what share of queries has a correct image among the first, and how many are correct."""
    rows = [
        [
            name if method == POSSIBLE else "",
            method,
            *(f"{100 * recall:.0f}" for recall in found["recalls"]),
            f"{100 * found['share']:.0f}",
        ]
        for name, measured in result["sets"].items()
        for method, found in measured["methods"].items()
    ]
    header = [
        "set",
        "images",
        *(f"top {rank}" for rank in _list_ranks(result["num_anchors"])),
        f"correct of {result['num_anchors']}",
    ]
    sizes = ", ".join(
        f"{name} {measured['num_queries']} of {measured['num_mapped']}"
        for name, measured in result["sets"].items()
    )
    k, most = result["num_anchors"], result["num_queries"]
    introduction = (
        f"Share of the queries (%) with a correct image among the first, and how many of {k}, or "
        "of all in a smaller map, are correct (%, mean). An image is correct that sees at least "
        f"{MIN_OVERLAP:.0%} of what the query sees, from the true poses and the query's median "
        "depth (the overlap of frusta of RelocNet, Balntas et al. 2018), under a parallax of "
        f"{MAX_PARALLAX_DEG:.0f} degrees at most. Network `{result['model']}`. Queries, {most} of "
        f"a set at the most, by a fixed seed, and mapped images: {sizes}."
    )
    return "\n\n".join([introduction, markdown(header, rows, num_words=2), *_conclude(result)])


def _conclude(result: Mapping[str, Any]) -> list[str]:
    """Say what the numbers say of the descriptors, and of the paper's claims.

    They are those of real images, where there are any: the rendered room is unlike them.
    """
    real = {name: measured for name, measured in result["sets"].items() if name != ROOM}
    sets = real or result["sets"]
    queries = "all queries of real images" if real else "all queries"
    weights = np.array([measured["num_queries"] for measured in sets.values()])

    def over_all(method: str) -> tuple[float, float]:
        """Return top 1 and the share of correct images, of all queries together."""
        found = [measured["methods"][method] for measured in sets.values()]
        top, shares = ([f["recalls"][0] for f in found], [f["share"] for f in found])
        return float(np.average(top, weights=weights)), float(np.average(shares, weights=weights))

    share, possible = over_all(PACKAGED)[1], over_all(POSSIBLE)[1]
    methods = [m for m in next(iter(sets.values()))["methods"] if m not in (POSSIBLE, CHANCE)]
    methods.sort(key=lambda method: -over_all(method)[0])
    compared = "; ".join(
        f"{method} {100 * over_all(method)[0]:.1f} and {100 * over_all(method)[1]:.1f}"
        for method in methods
    )
    mostly = [name for name, m in sets.items() if m["methods"][PACKAGED]["share"] > 0.5]
    return [
        (
            f"Over {queries}, the first image is correct, and of the first "
            f"{result['num_anchors']} are, in %: {compared}."
        ),
        (
            "The paper says that the vast majority of the recalled images are near the query, but "
            "for data sets that do not have so many. Here more than half are correct in "
            f"{len(mostly)} of {len(sets)} sets ({'; '.join(mostly) or 'none'}). Of the places "
            "that correct images of the map could take, the packaged descriptor fills "
            f"{100 * share / possible:.0f} %, and images drawn at random would fill "
            f"{100 * over_all(CHANCE)[1] / possible:.0f} %."
            + _describe_lack(100 * (possible - share), 100 * (1 - possible))
        ),
    ]


def _describe_lack(not_found: float, not_mapped: float) -> str:
    """Say of two percentages which is why images are not correct, unless hardly any are not."""
    if max(not_found, not_mapped) < MIN_LACK_PERCENT:
        return ""
    missing = "not in the map" if not_mapped > not_found else "not found"
    return (
        f" Of all places, {not_found:.1f} % lack a correct image that the map has, and "
        f"{not_mapped:.1f} % one that it has not: what lacks is mostly {missing}."
    )


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw histograms of how many images are correct, and a query with what is found for it."""
    figure = make_figure(7.0, 5.6)
    grid = figure.add_gridspec(2, 1, height_ratios=(1, 1.1))
    _draw_histograms(figure.add_subfigure(grid[0]), result)
    _draw_recalled(figure.add_subfigure(grid[1]), result["sets"][ROOM])
    save_figure(figure, path)


def _draw_histograms(figure: SubFigure, result: Mapping[str, Any]) -> None:
    sets = result["sets"]
    panels = figure.subplots(2, -(-len(sets) // 2), squeeze=False, sharex=True).ravel()
    edges = np.linspace(0, 100, NUM_BINS + 1)
    for axes in panels[len(sets) :]:
        axes.remove()
    for axes, (name, measured) in zip(panels, sets.items(), strict=False):
        methods, total = measured["methods"], measured["num_queries"] / 100
        for method, color in ((POSSIBLE, "0.75"), (PACKAGED, "C0")):
            heights = np.array(methods[method]["histogram"]) / total
            axes.stairs(heights, edges, color=color, fill=method == POSSIBLE, label=method)
        axes.axvline(100 * methods[CHANCE]["share"], color="crimson", ls=":", label=CHANCE)
        axes.set_title(name, fontsize="small")
    figure.supxlabel(
        f"correct images among the first {result['num_anchors']} (%)", fontsize="small"
    )
    figure.supylabel("queries (%)", fontsize="small")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)


def _draw_recalled(figure: SubFigure, room: Mapping[str, Any]) -> None:
    """Draw a query of the rendered room, and its images in order: green ones are correct."""
    world, shown = make_room(ROOM_SEED), room["shown"]
    query = _find_shown(world, room)
    survey = survey_poses(world, room["num_mapped"], ROOM_SEED)
    grid = figure.add_gridspec(1, 2, width_ratios=(1, 2))
    left, right = figure.add_subfigure(grid[0]), figure.add_subfigure(grid[1])
    left.suptitle(f"a query in the {ROOM}", fontsize="small")
    right.suptitle("the most alike: green ones see the same, red ones do not", fontsize="small")
    _draw_view(left.subplots(), world, query, "black")
    panels = right.subplots(SHOWN_ROWS, SHOWN_COLUMNS).ravel()
    for axes, index, is_correct in zip(panels, shown["images"], shown["is_correct"], strict=False):
        _draw_view(axes, world, survey[index], "tab:green" if is_correct else "tab:red")


def _find_shown(world: World, room: Mapping[str, Any]) -> Rigid3:
    """Return the pose of the query that is drawn."""
    shown = room["shown"]
    return flight_poses(world, shown["of"], ROOM_SEED)[shown["query"]]


def _draw_view(axes: Axes, world: World, cam_from_world: Rigid3, color: str) -> None:
    image = render(world, THUMBNAIL, cam_from_world, seed=None)
    axes.imshow(image, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    axes.set(xticks=(), yticks=())
    axes.spines[:].set(color=color, linewidth=2)
