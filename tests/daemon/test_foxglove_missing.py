"""What is said where the package of live views is missing."""

import sys

import pytest

from trigpoint.errors import ConfigError
from trigpointd.config import FoxgloveConfig
from trigpointd.sinks.foxglove import FoxgloveSink


def test_without_the_sdk_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(ConfigError, match=r"pip install 'trigpoint\[foxglove\]'") as caught:
        FoxgloveSink(FoxgloveConfig(), "base")
    assert "\n" not in str(caught.value)
