"""What a network says of itself: the JSON in its metadata property `trigpoint`.

There are three kinds: `FeaturesContract` (keypoints and local descriptors of an image, perhaps a
global one), `RetrievalContract` (a global descriptor of an image) and `MatcherContract` (matches of
two sets of features). Each tells which tensors the network has, of what shapes, so that a network
made elsewhere needs no more than this JSON. docs/models.md describes every field.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from trigpoint.errors import ModelError

METADATA_KEY = "trigpoint"

Count = Annotated[int, Field(ge=1, le=65_536)]
# "standardize": (x - mean) / max(std, 4), clipped to +-4; "unit": x / 255; "imagenet": the latter
# less the mean of ImageNet's colours, by their deviation; "raw": x, of 0 to 255.
Normalization = Literal["standardize", "unit", "imagenet", "raw"]
Shape = tuple[int | None, ...]  # None: any
Shapes = dict[str, tuple[Shape, ...]]  # by tensor: what shapes it may have


class _Contract(BaseModel):
    """What all kinds have."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    name: Annotated[str, Field(min_length=1)]  # for people
    names: dict[str, str] = {}  # of tensors that the file calls otherwise than the contract

    @property
    @abstractmethod
    def inputs(self) -> Shapes:
        """Shapes of the inputs."""

    @property
    @abstractmethod
    def outputs(self) -> Shapes:
        """Shapes of the outputs."""

    def tensor(self, name: str) -> str:
        """Return what the file calls a tensor of the contract."""
        return self.names.get(name, name)

    def to_json(self) -> str:
        """Write the metadata property."""
        return self.model_dump_json()

    @model_validator(mode="after")
    def _names_are_known(self) -> Self:
        known = [*self.inputs, *self.outputs]
        for name in self.names:
            if name not in known:
                raise ValueError(f"names {name!r}, which is none of {', '.join(known)}")
        return self


class ImageContract(_Contract):
    """What the kinds that take an image have."""

    channels: Literal[1, 3] = 1  # the gray levels, once or three times
    normalization: Normalization = "unit"

    @model_validator(mode="after")
    def _colours_are_three(self) -> Self:
        if self.normalization == "imagenet" and self.channels != 3:
            raise ValueError("normalization 'imagenet' is of 3 channels")
        return self


class FeaturesContract(ImageContract):
    """Of a network that gives keypoints and local descriptors."""

    kind: Literal["features"] = "features"
    layout: Literal["dense", "sparse"] = "dense"  # maps over the image, or lists of keypoints
    descriptor_dim: Count
    global_dim: Annotated[int, Field(ge=0, le=65_536)] = 0  # 0: there is no output `global`
    multiple_of: Count = 1  # H and W of the input
    long_side_px: Count = 640  # larger images are scaled down to this
    min_score: float = 0.0  # a keypoint's score is above this
    # Of the sparse layout: (0, 0) is the centre of the first pixel, or (-1, -1) is it and (1, 1)
    # that of the last.
    keypoints: Literal["px", "normalized"] = "px"

    @property
    def inputs(self) -> Shapes:
        """Shapes of the inputs."""
        return {"image": ((1, self.channels, None, None),)}

    @property
    def outputs(self) -> Shapes:
        """Shapes of the outputs."""
        dim = self.descriptor_dim
        shapes: Shapes = {"score": ((1, 1, None, None),), "desc": ((1, dim, None, None),)}
        if self.layout == "sparse":
            shapes = {
                "keypoints": ((1, None, 2), (None, 2)),
                "scores": ((1, None), (None,)),
                "descriptors": ((1, None, dim), (None, dim), (1, dim, None)),
            }
        return shapes | ({"global": ((1, self.global_dim),)} if self.global_dim else {})


class RetrievalContract(ImageContract):
    """Of a network that gives the global descriptor of an image."""

    kind: Literal["retrieval"] = "retrieval"
    global_dim: Count
    height: Count  # images are scaled to this size
    width: Count
    channels: Literal[1, 3] = 3
    normalization: Normalization = "imagenet"

    @property
    def inputs(self) -> Shapes:
        """Shapes of the inputs."""
        return {"image": ((1, self.channels, self.height, self.width),)}

    @property
    def outputs(self) -> Shapes:
        """Shapes of the outputs."""
        return {"global": ((1, self.global_dim),)}


class MatcherContract(_Contract):
    """Of a network that matches the features of two images."""

    kind: Literal["matcher"] = "matcher"
    descriptor_dim: Count
    # "centered": (p - size / 2) / (max(size) / 2), which is LightGlue's, of the image's size
    keypoints: Literal["px", "centered"] = "centered"
    min_score: float = 0.0  # a match's score is above this

    @property
    def inputs(self) -> Shapes:
        """Shapes of the inputs."""
        points: tuple[Shape, ...] = ((1, None, 2),)
        descriptors: tuple[Shape, ...] = ((1, None, self.descriptor_dim),)
        return {"kpts0": points, "kpts1": points, "desc0": descriptors, "desc1": descriptors}

    @property
    def outputs(self) -> Shapes:
        """Shapes of the outputs: pairs, pairs behind the number of a batch, or by keypoint."""
        return {
            "matches": ((None, 2), (1, None, 2), (None, 3), (1, None)),
            "scores": ((None,), (1, None)),
        }


Contract = FeaturesContract | RetrievalContract | MatcherContract
_ADAPTER: TypeAdapter[Contract] = TypeAdapter(Annotated[Contract, Field(discriminator="kind")])


def make_contract(fields: dict[str, Any]) -> Contract:
    """Check the fields of a contract."""
    try:
        return _ADAPTER.validate_python(fields)
    except ValidationError as error:
        raise ModelError(_explain(error)) from error


def read_contract(text: str) -> Contract:
    """Read the metadata property."""
    try:
        return _ADAPTER.validate_json(text)
    except ValidationError as error:
        raise ModelError(_explain(error)) from error


def _explain(error: ValidationError) -> str:
    """Put one thing that is wrong in one line."""
    # A mistyped field is both unknown and missing: the former says more.
    first = min(error.errors(), key=lambda item: item["type"] != "extra_forbidden")
    field = ".".join(str(part) for part in first["loc"][1:])  # the first part is the kind
    if first["type"] == "extra_forbidden":
        return f"unknown field {field!r} in its contract"
    if first["type"] == "missing":
        return f"its contract lacks {field!r}"
    if first["type"] in ("union_tag_not_found", "union_tag_invalid"):
        return "its contract needs a 'kind': 'features', 'retrieval' or 'matcher'"
    what = first["msg"].removeprefix("Value error, ")
    return f"its contract: {field!r}: {what}" if field else f"its contract: {what}"
