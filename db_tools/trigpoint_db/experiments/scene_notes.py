"""What has to be known to read the tables of public benchmarks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from trigpoint_db.experiments.published import PublishedTable, load_published

SEVEN_SCENES_NOTE = (
    "The paper does not say by which poses of 7-Scenes it maps and judges: those by KinectFusion, "
    "the data set's own, or the pseudo ground truth by structure from motion (SfM) of Brachmann et "
    "al., ICCV 2021. Ours maps and judges by the same."
)
KITCHEN_NOTE = (
    "Ours is one sequence, seq-01, of which every seventh frame is there, with poses by structure "
    "from motion, and split by us: every fifth image held out, or whole stretches. The benchmark "
    "localizes other sequences than those that it maps, so ours are no rows of it, and do not say "
    "who is better."
)


def write_notes(result: Mapping[str, Any], table: PublishedTable) -> list[str]:
    """Write what has to be known of a benchmark's table; what is claimed follows from numbers."""
    return {
        "7scenes": [SEVEN_SCENES_NOTE, _repeats_note(table)],
        "cambridge": [_scale_note()],
        "aachen": [_submission_note(result, table)],
        "robotcar": [_submission_note(result, table)],
        "redkitchen": [KITCHEN_NOTE],
    }[result["benchmark"]]


def _repeats_note(table: PublishedTable) -> str:
    return " ".join(
        f"The published rows of {a} and {b} have the same numbers for {', '.join(columns)}: one of "
        "them may be a copy."
        for a, b, columns in table.repeated_cells()
    )


def _scale_note() -> str:
    """Say what the paper says of Cambridge's scale, and what its numbers do."""
    falls = []
    for name in ("cambridge", "7scenes"):
        table = load_published()[name]
        average = table.columns.index("Average")
        plain, better = (table.row(title).numbers(average) for title in ("HLoc", "HLoc + SG"))
        assert plain is not None
        assert better is not None
        falls.append([a / b for a, b in zip(plain, better, strict=True)])
    (deg, m), (deg_7, m_7) = falls
    return (
        "Scale: the caption of the paper's table says degrees/metres for both data sets, its text "
        "calls Cambridge's a much larger metric scale, and neither names a factor. Ours is the "
        "data set's own: positions as they stand in `dataset_train.txt` and `dataset_test.txt`, in "
        f"metres. From the row HLoc to HLoc + SG the printed average falls by a factor of {m:.1f} "
        f"in metres and {deg:.1f} in degrees here, and {m_7:.1f} and {deg_7:.1f} on 7-Scenes. "
        + (
            "A factor of scale would leave the degrees as they are, so it does not explain that."
            if deg > 1.5
            else "Degrees are nearly the same, so the metres may be scaled."
        )
    )


def _submission_note(result: Mapping[str, Any], table: PublishedTable) -> str:
    judged = sum(part["num_judged"] for part in result["parts"])
    total = sum(part["num_queries"] for part in result["parts"])
    public = (
        f"Ours is judged on the {judged} queries with a public pose, which are not those that the "
        "rows above are of. "
    )
    return public * bool(judged) + (
        f"The true poses of {total - judged} of the {total} queries are not public: the file "
        f"`{result['benchmark']}_submission.txt` beside this result is for "
        "https://www.visuallocalization.net to judge, and how many were localized is an upper "
        f"bound of each share. The paper counts {table.num_references} reference images, and "
        f"{result['parts'][0]['num_mapped']:,} are mapped here."
    )
