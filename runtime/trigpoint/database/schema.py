r"""How a map lies on disk: with `rows` and `codec` the only place that knows bytes.

A map is one LMDB file (data format of LMDB 0.9, 64 bit). Numbers are little-endian, in keys
big-endian so that they sort. Each value begins with the CRC-32 of its key and of all that follows:
neither an altered byte nor a value under a wrong key goes unnoticed.

    key                        value after the CRC
    00                         metadata, JSON
    00 01                      centroids of the index, where there is one: (L, G) f2
    00 02 list u32             a list of it: indices (n,) u4, then as a block
    01 name                    index of the image, u32
    02 block u32               up to 256 retrieval rows: scales (n,) f4, camera centers (n, 3) f4,
                               sessions (n,) u2, numbers (n, G) i1
    03 index u32 00            an image: pose, camera, sizes, its first keypoints, name
    03 index u32 01            its features: other keypoints (N - j, 2) u2, descriptors

Keypoints are fixed point, `x = u step - 0.5` with `step = max(width, height) / 65535` px.
Descriptors are (N, D) i1, `i 4 / (127 sqrt(D))`: numbers of a unit vector have a standard deviation
of 1 / sqrt(D); those of a compact map are as `codec` makes them. Retrieval rows have a scale each,
which makes the stored row a unit vector. Their sessions are places in the metadata's list, from 1
on; 0 is no session.
"""

from __future__ import annotations

import dataclasses
import json
import struct
import zlib
from dataclasses import dataclass
from datetime import date

import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import PARAMETERS, Camera
from trigpoint.database.codec import (
    Profile,
    decode_descriptors,
    descriptor_bytes,
    encode_descriptors,
)
from trigpoint.database.pages import HEADER_BYTES, DamageError
from trigpoint.database.rows import Row
from trigpoint.errors import ConfigError, DatabaseError
from trigpoint.frame import (
    LocalFeatures,
    ModelIdentity,
    PoseNoise,
    Session,
    restore_descriptors,
)
from trigpoint.rigid import Rigid3

Array32 = NDArray[np.float32]

FORMAT = 5
BLOCK_ROWS = 256
MAX_NAME_BYTES = 500  # LMDB's keys end at 511
MAX_KEYPOINTS = 65_535
MAX_CAMERA_PARAMETERS = 12
MAX_SESSIONS = 65_535
NO_SESSION = 0

METADATA_KEY = b"\x00"
CENTROIDS_KEY = b"\x00\x01"
_CRC = struct.Struct("<I")
_INDEX = struct.Struct("<I")
# Quaternion and t, parameters, model; width, height, keypoints; how many of these lie here.
_IMAGE = struct.Struct(f"<7d {MAX_CAMERA_PARAMETERS}d 24s III H")
_NUM_INLINE = struct.Struct("<H")  # its end
_MAX_INLINE_BYTES = 1024


def list_key(number: int) -> bytes:
    """Key of a list of the index."""
    return struct.pack(">BBI", 0, 2, number)


def name_key(name: str) -> bytes:
    """Key of the index entry of an image's name."""
    return b"\x01" + name.encode()


def block_key(block: int) -> bytes:
    """Key of the retrieval rows of images 256 block, 256 block + 1..."""
    return struct.pack(">BI", 2, block)


def image_key(index: int) -> bytes:
    """Key of an image; sorts last, so that images are appended at the end of the tree."""
    return struct.pack(">BIB", 3, index, 0)


def features_key(index: int) -> bytes:
    """Key of an image's features; follows the image's."""
    return struct.pack(">BIB", 3, index, 1)


def describe_key(key: bytes) -> str:
    """Say for people what lies under a key."""
    if key == METADATA_KEY:
        return "the map's metadata"
    if key == CENTROIDS_KEY:
        return "the centroids of the index"
    if key[0] == 0:
        return f"list {int.from_bytes(key[2:], 'big')} of the index"
    if key[0] == 1:
        return f"the index entry of {key[1:].decode()!r}"
    number = int.from_bytes(key[1:5], "big")
    return f"retrieval block {number}" if key[0] == 2 else f"image {number}"


def seal(key: bytes, payload: bytes) -> bytes:
    """Put the checksum before a value."""
    return _CRC.pack(zlib.crc32(payload, zlib.crc32(key))) + payload


def unseal(key: bytes, value: memoryview | None, *, check: bool = True) -> memoryview:
    """Return what follows the checksum, after comparing it."""
    if value is None:
        raise DamageError(f"{describe_key(key)} is missing")
    payload = value[_CRC.size :]
    if check and value[: _CRC.size] != _CRC.pack(zlib.crc32(payload, zlib.crc32(key))):
        raise DamageError(f"{describe_key(key)} is damaged: its checksum does not match")
    return payload


@dataclass(frozen=True)
class InvertedFile:
    """An index of the first rows of a map, as they were when it was made."""

    num_rows: int
    num_lists: int
    moved: tuple[int, ...] = ()  # rows of these that others have taken the place of since


@dataclass(frozen=True)
class Metadata:
    """What a map says of itself."""

    model: ModelIdentity  # of the network that made the features
    generation: int = 0  # rises with each commit
    num_images: int = 0
    pose_noise: PoseNoise | None = None  # as measured
    sessions: tuple[Session, ...] = ()
    profile: Profile = Profile.STANDARD
    index: InvertedFile | None = None

    def encode(self) -> bytes:
        """Write JSON."""
        fields = {"format": FORMAT, **dataclasses.asdict(self)}
        return json.dumps(fields, default=date.isoformat).encode()

    @classmethod
    def decode(cls, payload: bytes) -> Metadata:
        """Read JSON of this version."""
        fields = json.loads(payload)
        if (found := fields.pop("format")) != FORMAT:
            raise DatabaseError(
                f"a map of format {found}, and this version reads format {FORMAT}; "
                "rebuild it with `trigpoint-db build` or use the version that made it"
            )
        noise, sessions, index = (fields[key] for key in ("pose_noise", "sessions", "index"))
        profile = fields["profile"]
        if profile not in list(Profile):
            raise DatabaseError(f"a map of profile {profile!r}; use the version that made it")
        return cls(
            **fields
            | {
                "model": ModelIdentity(**fields["model"]),
                "pose_noise": None if noise is None else PoseNoise(**noise),
                "sessions": tuple(
                    Session(s["name"], s["date"] and date.fromisoformat(s["date"]))
                    for s in sessions
                ),
                "profile": Profile(profile),
                "index": index
                and InvertedFile(index["num_rows"], index["num_lists"], tuple(index["moved"])),
            }
        )


@dataclass(frozen=True, eq=False)
class Record:
    """An image as it lies in a map, ready for another one; `row.session` is the former's."""

    name: str
    image: bytes
    features: bytes
    row: Row
    session: Session | None
    profile: Profile  # of its descriptors


def encode_index(index: int) -> bytes:
    """Write the index entry of a name."""
    return _INDEX.pack(index)


def decode_index(payload: memoryview) -> int:
    """Read the index entry of a name."""
    index: int = _INDEX.unpack(payload)[0]
    return index


@dataclass(frozen=True, eq=False)
class Image:
    """An image without its features."""

    name: str
    camera: Camera
    cam_from_world: Rigid3
    num_keypoints: int
    first_keypoints: NDArray[np.uint16]  # (j, 2), fixed point


def encode_image(
    name: str,
    camera: Camera,
    cam_from_world: Rigid3,
    features: LocalFeatures,
    profile: Profile,
) -> tuple[bytes, bytes]:
    """Write an image and its features."""
    step = _keypoint_step_px(camera)
    keypoints = np.rint((features.keypoints.astype(np.float64) + 0.5) / step).astype("<u2")
    header = _IMAGE.pack(
        *cam_from_world.quaternion,
        *cam_from_world.t,
        *np.pad(camera.params, (0, MAX_CAMERA_PARAMETERS - len(camera.params))),
        camera.model.encode(),
        camera.width,
        camera.height,
        len(features),
        0,
    )
    return _divide(header, name, keypoints, encode_descriptors(features.descriptors, profile))


def _divide(
    header: bytes, name: str, keypoints: NDArray[np.uint16], descriptors: bytes
) -> tuple[bytes, bytes]:
    """Put the keypoints (N, 2) where they take the least space.

    LMDB gives a large value whole pages. Where the features would hang over their last page but a
    little (1024 x 64 are 17 pages and 20 bytes), the first keypoints go to the image instead, which
    lies in the tree's own pages.
    """
    stored = HEADER_BYTES + _CRC.size + keypoints.nbytes + len(descriptors)
    overhang = stored % 4096 if stored > 4096 else 0
    num_inline = -(-overhang // 4) if overhang <= min(_MAX_INLINE_BYTES, keypoints.nbytes) else 0
    header = header[: -_NUM_INLINE.size] + _NUM_INLINE.pack(num_inline)
    return (
        header + keypoints[:num_inline].tobytes() + name.encode(),
        keypoints[num_inline:].tobytes() + descriptors,
    )


def recode(record: Record, dim: int, profile: Profile) -> Record:
    """Write an image with descriptors of `dim` numbers as a map of another profile has it."""
    if record.profile == profile:
        return record
    image = decode_image(memoryview(record.image))
    keypoints, descriptors = _split(image, memoryview(record.features), dim, record.profile)
    numbers = restore_descriptors(decode_descriptors(descriptors, dim, record.profile))
    header, encoded = record.image[: _IMAGE.size], encode_descriptors(numbers, profile)
    written, features = _divide(header, image.name, keypoints, encoded)
    return dataclasses.replace(record, image=written, features=features, profile=profile)


def decode_name(payload: memoryview) -> str:
    """Read an image's name only."""
    num_inline = _IMAGE.unpack_from(payload)[-1]
    return bytes(payload[_IMAGE.size + 4 * num_inline :]).decode()


def rename_image(payload: bytes, name: str) -> bytes:
    """Write an image under another name."""
    num_inline = _IMAGE.unpack_from(payload)[-1]
    return payload[: _IMAGE.size + 4 * num_inline] + name.encode()


def decode_image(payload: memoryview) -> Image:
    """Read an image."""
    *numbers, model, width, height, num_keypoints, num_inline = _IMAGE.unpack_from(payload)
    model = model.rstrip(b"\0").decode()
    params = numbers[7 : 7 + len(PARAMETERS.get(model, ()))]
    try:
        camera = Camera(model, width, height, tuple(params))
    except ConfigError as error:
        raise DatabaseError(f"made by another version of Trigpoint: {error}") from error
    inline = payload[_IMAGE.size : _IMAGE.size + 4 * num_inline]
    return Image(
        name=decode_name(payload),
        camera=camera,
        cam_from_world=Rigid3.from_quaternion(numbers[:4], numbers[4:7]),
        num_keypoints=num_keypoints,
        first_keypoints=np.frombuffer(inline, "<u2").reshape(-1, 2),
    )


def decode_features(
    image: Image, payload: memoryview, dim: int, profile: Profile
) -> tuple[Array32, NDArray[np.int8]]:
    """Read keypoints (N, 2) in px and quantized descriptors (N, D)."""
    fixed, descriptors = _split(image, payload, dim, profile)
    keypoints = (fixed * _keypoint_step_px(image.camera) - 0.5).astype(np.float32)
    return keypoints, decode_descriptors(descriptors, dim, profile)


def _split(
    image: Image, payload: memoryview, dim: int, profile: Profile
) -> tuple[NDArray[np.uint16], memoryview]:
    """Return an image's keypoints (N, 2), fixed point, and its descriptors as they lie."""
    split = 4 * (image.num_keypoints - len(image.first_keypoints))
    if len(payload) != split + descriptor_bytes(dim, profile) * image.num_keypoints:
        raise DamageError(f"{image.name!r} has features that are not its own")
    others = np.frombuffer(payload[:split], "<u2").reshape(-1, 2)
    return np.concatenate([image.first_keypoints, others]), payload[split:]


def _keypoint_step_px(camera: Camera) -> float:
    return max(camera.width, camera.height) / 65_535
