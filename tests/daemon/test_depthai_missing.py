"""What is said where the package of OAK cameras is missing."""

import sys

import pytest

from trigpoint.errors import ConfigError
from trigpointd.config import DepthaiConfig
from trigpointd.sources.depthai import DepthaiSource


def test_without_depthai_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "depthai", None)
    with pytest.raises(ConfigError, match=r"pip install 'trigpoint\[oak\]'") as caught:
        DepthaiSource(DepthaiConfig(type="depthai"))
    assert "\n" not in str(caught.value)
