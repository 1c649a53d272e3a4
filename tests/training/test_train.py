import json
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `train`")

from training import scenes, train


@pytest.fixture
def command(corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for index in range(2):
        drawing = scenes.drawing(np.random.default_rng(index))
        cv2.imwrite(str(photographs / f"{index}.png"), drawing)
    for name in ("LOG_EVERY", "CHECKPOINT_EVERY", "VALIDATE_EVERY"):
        monkeypatch.setattr(train, name, 2)
    folders = {"photographs": photographs, "edgepoint2": tmp_path, "alike": tmp_path}
    folders["corpus"] = corpus
    options = [str(part) for name, folder in folders.items() for part in (f"--{name}", folder)]
    return ["tiny", *options, "--pairs", "1", "--workers", "0", "--threads", "1"]


@pytest.mark.slow
def test_training_goes_on_where_it_was_interrupted(command: list[str], tmp_path: Path) -> None:
    train.main([*command, "--steps", "6", "--out", str(tmp_path / "whole")])
    whole = torch.load(tmp_path / "whole" / "checkpoint.pt")

    class CutError(Exception):
        pass

    def cut(*_: object) -> None:
        raise CutError

    draw, train.draw_curve = train.draw_curve, cut  # the last thing done at step 2
    try:
        with pytest.raises(CutError):
            train.main([*command, "--steps", "6", "--out", str(tmp_path / "parts")])
    finally:
        train.draw_curve = draw
    assert torch.load(tmp_path / "parts" / "checkpoint.pt")["step"] == 2
    train.main([*command, "--steps", "6", "--out", str(tmp_path / "parts")])
    parts = torch.load(tmp_path / "parts" / "checkpoint.pt")
    assert parts["step"] == whole["step"] == 6
    for name, values in whole["network"].items():
        assert torch.equal(values, parts["network"][name]), name
    logs = [(tmp_path / name / "log.jsonl").read_text() for name in ("whole", "parts")]
    assert logs[0] == logs[1]
    assert [json.loads(line)["step"] for line in logs[0].splitlines()] == [2, 4, 6]
    assert cv2.imread(str(tmp_path / "whole" / "curve.png")) is not None


def test_another_profile_does_not_go_on_from_a_checkpoint(
    command: list[str], tmp_path: Path
) -> None:
    torch.save({"profile": {}}, tmp_path / "checkpoint.pt")
    with pytest.raises(SystemExit, match="another profile"):
        train.main([*command, "--steps", "2", "--out", str(tmp_path)])
