"""A map survives whatever happens to those who change it; see `kills`."""

from pathlib import Path

import pytest

from tests.unit.kills import kill_often


@pytest.mark.slow
def test_processes_killed_at_random_moments_lose_no_image_but_the_one_in_work(
    tmp_path: Path,
) -> None:
    killed_at = kill_often(tmp_path, 40)
    assert killed_at.total() == 40
    assert killed_at["nothing"] < 40
