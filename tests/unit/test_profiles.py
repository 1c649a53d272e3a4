"""What a map spends on an image, and what comes back of it."""

import math
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.conftest import Demo
from tests.unit.maps import MODEL, add, make_features, make_map, unit
from tests.unit.test_database_damage import alter_byte, alter_entry
from trigpoint.database import schema
from trigpoint.database.codec import Profile, decode_descriptors, encode_descriptors
from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import (
    compact_map,
    growing_map,
    name_map,
    new_map,
    partial_map,
)
from trigpoint.database.writer import MapWriter
from trigpoint.errors import DatabaseError
from trigpoint.frame import Frame, Localized, describe, restore_descriptors
from trigpoint.images import read_gray
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint_db.demo import BODY_FROM_CAMERA
from trigpoint_db.demo import CAMERA as DEMO_CAMERA
from trigpoint_db.maps import merge_maps
from trigpoint_db.poses import read_poses


def make_compact(path: Path, num_images: int) -> Path:
    with new_map(path, MODEL, Profile.COMPACT) as writer:
        for index in range(num_images):
            add(writer, index)
    return path


@given(dim=st.integers(1, 300), seed=st.integers(0, 2**32 - 1))
def test_descriptors_of_two_bits_are_near_what_they_were(dim: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Not alike in all numbers, as those of networks are: the first ones are larger.
    descriptors = unit((rng.standard_normal((50, dim)) + 0.5) / (1 + np.arange(dim)) ** 0.5)
    encoded = encode_descriptors(descriptors, Profile.COMPACT)
    assert len(encoded) == 50 * max(4, 2 ** int(np.ceil(np.log2(dim)))) // 4
    decoded = restore_descriptors(decode_descriptors(memoryview(encoded), dim, Profile.COMPACT))
    cosines = np.einsum("ij,ij->i", descriptors, decoded)
    assert np.median(cosines) > 0.9
    assert cosines.min() > 0.7


def test_what_was_decoded_is_encoded_as_it_was() -> None:
    descriptors = make_features(0, 1000).descriptors
    for profile in Profile:
        encoded = encode_descriptors(descriptors, profile)
        decoded = decode_descriptors(memoryview(encoded), MODEL.descriptor_dim, profile)
        again = decode_descriptors(
            memoryview(encode_descriptors(restore_descriptors(decoded), profile)),
            MODEL.descriptor_dim,
            profile,
        )
        assert (decoded != again).mean() < 0.02  # of a number on the edge of two levels


def test_bytes_mean_what_the_documentation_says() -> None:
    """Number by number, in integers: maps are read years later, on other machines."""
    codes = np.random.default_rng(0).bytes(16)
    levels = [(-10, -3, 3, 10)[byte >> shift & 3] for byte in codes for shift in (0, 2, 4, 6)]

    def sign(i: int, j: int) -> int:
        return -1 if ((i & j).bit_count() + (j & j >> 1).bit_count()) % 2 else 1

    numbers = [sum(levels[i] * sign(i, j) for i in range(64)) for j in range(64)]
    length = math.sqrt(sum(number**2 for number in numbers))
    wanted = [max(-127, min(127, round(254 * number / length))) for number in numbers]
    assert decode_descriptors(memoryview(codes), 64, Profile.COMPACT).tolist() == [wanted]


def test_a_compact_map_is_like_a_standard_one_but_for_its_descriptors(tmp_path: Path) -> None:
    standard, compact = make_map(tmp_path / "a.tpmap", 3), make_compact(tmp_path / "b.tpmap", 3)
    with MapReader.open(standard) as a, MapReader.open(compact) as b:
        assert (a.profile, b.profile) == (Profile.STANDARD, Profile.COMPACT)
        assert b.verify() == []
        for index in range(3):
            one, other = a.anchor(index), b.anchor(index)
            np.testing.assert_array_equal(one.keypoints, other.keypoints)
            assert one.descriptors.shape == other.descriptors.shape
            products = restore_descriptors(one.descriptors) * restore_descriptors(other.descriptors)
            assert products.sum(axis=1).mean() > 0.9


def test_a_compact_image_of_1024_keypoints_takes_less_than_24_kilobytes(tmp_path: Path) -> None:
    model = replace(MODEL, descriptor_dim=64, global_dim=256)
    path = tmp_path / "a.tpmap"
    with MapWriter.create(path, model, Profile.COMPACT) as writer:
        for index in range(100):
            add(writer, index, features=make_features(index, 1024, model))
    assert path.stat().st_size < 100 * 24_000


def test_images_added_have_the_profile_of_the_map(tmp_path: Path) -> None:
    path = make_compact(tmp_path / "a.tpmap", 2)
    with MapWriter.open(path, MODEL) as writer:
        add(writer, 2)
    together = make_compact(tmp_path / "b.tpmap", 3)
    with MapReader.open(path) as reader, MapReader.open(together) as wanted:
        np.testing.assert_array_equal(reader.anchor(2).descriptors, wanted.anchor(2).descriptors)
        assert reader.verify() == []


def test_a_map_becomes_compact_under_its_readers(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 5)
    path.chmod(0o640)
    wanted = make_compact(tmp_path / "b.tpmap", 5)
    with MapReader.open(path) as reader:
        generation = reader.generation
        compact_map(path, profile=Profile.COMPACT)
        assert reader.profile == Profile.STANDARD
        assert reader.refresh()
        assert (reader.profile, reader.verify()) == (Profile.COMPACT, [])
        assert reader.generation > generation
        with MapReader.open(wanted) as other:
            for index in range(5):
                one = restore_descriptors(reader.anchor(index).descriptors)
                two = restore_descriptors(other.anchor(index).descriptors)
                assert (one * two).sum(axis=1).mean() > 0.99
    assert path.stat().st_mode & 0o777 == 0o640


def test_what_a_compact_map_left_out_does_not_come_back(tmp_path: Path) -> None:
    path = make_compact(tmp_path / "a.tpmap", 2)
    before = path.read_bytes()
    with pytest.raises(DatabaseError, match="rebuild it"):
        compact_map(path, profile=Profile.STANDARD)
    assert path.read_bytes() == before


def test_a_merged_map_has_the_profile_of_the_first(tmp_path: Path) -> None:
    standard, compact = make_map(tmp_path / "a.tpmap", 2), make_compact(tmp_path / "b.tpmap", 2)
    for first, second in ((standard, compact), (compact, standard)):
        out = tmp_path / f"{first.stem}{second.stem}.tpmap"
        merge_maps(first, second, out, prefix="second/")
        with MapReader.open(out) as reader, MapReader.open(first) as source:
            assert (reader.profile, reader.verify()) == (source.profile, [])
            one = restore_descriptors(reader.anchor(0).descriptors)
            two = restore_descriptors(reader.anchor(2).descriptors)
            assert (one * two).sum(axis=1).mean() > 0.9


def test_a_build_that_goes_on_keeps_its_profile(tmp_path: Path) -> None:
    path = tmp_path / "a.tpmap"
    with (
        suppress(KeyboardInterrupt),
        growing_map(path, MODEL, Profile.COMPACT, resume=False) as w,
    ):
        add(w, 0)
        w.commit()
        raise KeyboardInterrupt
    with (
        pytest.raises(DatabaseError, match="was begun with the compact profile"),
        growing_map(path, MODEL, Profile.STANDARD, resume=True),
    ):
        pass
    with growing_map(path, MODEL, resume=True) as w:
        add(w, 1)
    name_map(partial_map(path), path)
    with MapReader.open(path) as reader:
        assert (len(reader), reader.profile) == (2, Profile.COMPACT)


def test_a_map_that_another_goes_on_with_gets_no_name(tmp_path: Path) -> None:
    path = tmp_path / "a.tpmap"
    with growing_map(path, MODEL, resume=False) as first:
        add(first, 0)
    with growing_map(path, MODEL, resume=True) as second:
        with pytest.raises(DatabaseError, match="another writer has it open"):
            name_map(partial_map(path), path)
        add(second, 1)
    name_map(partial_map(path), path)
    with MapReader.open(path) as reader:
        assert (len(reader), reader.verify()) == (2, [])


def test_a_flipped_bit_in_a_compact_map_is_found(tmp_path: Path) -> None:
    path = make_compact(tmp_path / "a.tpmap", 3)
    alter_byte(path, encode_descriptors(make_features(1).descriptors, Profile.COMPACT))
    with MapReader.open(path) as reader:
        with pytest.raises(DatabaseError, match="image 1 is damaged"):
            reader.anchor(1)
        assert reader.verify() == ["image 1 is damaged: its checksum does not match (folder/1.png)"]
        reader.anchor(2)


def test_a_profile_of_a_later_version_is_refused(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 1)
    metadata = schema.Metadata(MODEL, 1, 1).encode().replace(b'"standard"', b'"tiny"')
    alter_entry(path, schema.METADATA_KEY, metadata)
    with pytest.raises(DatabaseError, match="of profile 'tiny'; use the version that made it"):
        MapReader.open(path)


def test_the_room_is_found_in_a_compact_map(
    demo: Demo, model: FeatureModel, tmp_path: Path
) -> None:
    path = tmp_path / "compact.tpmap"
    path.write_bytes(demo.map.read_bytes())
    compact_map(path, profile=Profile.COMPACT)
    assert path.stat().st_size < 0.36 * demo.map.stat().st_size
    truth = list(read_poses(demo.truth).values())
    frames = sorted((demo.folder / "flight").glob("*.jpg"))
    with MapReader.open(path, model.identity) as reader:
        localizer = Localizer(model, reader)
        for i in (0, 5, 10):
            result = localizer.localize(Frame(read_gray(frames[i]), DEMO_CAMERA))
            assert isinstance(result, Localized), describe(result)
            true_center = (BODY_FROM_CAMERA.inverse() @ truth[i]).center
            assert np.linalg.norm(result.cam_from_world.center - true_center) < 0.02
