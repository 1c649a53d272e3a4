"""What peers ask for, without a network: every request has an answer, a wrong one the reason."""

import asyncio
import contextlib
import json
import re
import threading
from collections.abc import AsyncGenerator, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.conftest import Demo
from trigpoint.database.reader import MapReader
from trigpoint.errors import RequestError
from trigpoint.frame import Frame
from trigpoint.images import read_gray
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.build import build_map
from trigpoint_db.demo import CAMERA
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.importers.colmap import read_model
from trigpointd.config import Config, McapConfig, RequestsConfig
from trigpointd.pipeline import Output, Pipeline
from trigpointd.request_queue import RequestQueue
from trigpointd.requests import Answer, Request, Responder
from trigpointd.service import serve
from trigpointd.sources.base import Captured

EVERYTHING = RequestsConfig.model_validate(
    {
        "allow": ("localize", "map", "change_map", "config"),
        "cameras": {"phone": CAMERA.to_text()},
    }
)


@pytest.fixture(scope="module")
def survey(demo: Demo) -> list[PosedImage]:
    return read_model(demo.folder / "sparse")


def files(demo: Demo, image: PosedImage) -> bytes:
    return (demo.folder / "survey" / image.name).read_bytes()


def format_pose(pose: Rigid3) -> str:
    return " ".join(map(str, (*pose.quaternion, *pose.t)))


class Asker:
    """Asks a responder, as a peer would."""

    def __init__(self, responder: Responder) -> None:
        self.responder = responder

    def __call__(
        self, kind: str, payload: bytes = b"", encoding: str = "", **parameters: str
    ) -> dict[str, Any]:
        answer = self.responder.answer(Request(kind, parameters, encoding, payload))
        assert not answer.is_error, answer.payload
        result: dict[str, Any] = json.loads(answer.payload)
        return result

    def error(self, kind: str, payload: bytes = b"", encoding: str = "", **parameters: str) -> str:
        answer = self.responder.answer(Request(kind, parameters, encoding, payload))
        assert answer.is_error
        text = answer.payload.decode()
        assert "\n" not in text
        return text


def open_asker(
    path: Path, model: FeatureModel, reader: MapReader, limits: RequestsConfig = EVERYTHING
) -> Asker:
    config = Config(map=path, source=McapConfig(type="mcap", path=path))
    pipeline = Pipeline(Localizer(model, reader), reader, Rigid3.identity(), "map")
    return Asker(Responder(config, limits, pipeline))


@pytest.fixture(scope="module")
def ask(demo: Demo, model: FeatureModel) -> Iterator[Asker]:
    """Of the demo's map, which no test of these may change."""
    with MapReader.open(demo.map, model.identity) as reader:
        limits = EVERYTHING.model_copy(update={"allow": ("localize", "map", "config")})
        yield open_asker(demo.map, model, reader, limits)


@pytest.fixture
def ask_small(
    demo: Demo, model: FeatureModel, survey: list[PosedImage], tmp_path: Path
) -> Iterator[Asker]:
    """Of a map of 12 images, to do with as one likes."""
    path = tmp_path / "m.tpmap"
    build_map(path, survey[:12], demo.folder / "survey", model)
    with MapReader.open(path, model.identity) as reader:
        yield open_asker(path, model, reader)


@pytest.mark.parametrize("camera", ["phone", CAMERA.to_text()])
@pytest.mark.parametrize("encoding", ["image/jpeg", "image/png", "application/octet-stream"])
def test_an_image_of_the_map_is_found_where_it_was_taken(
    ask: Asker, demo: Demo, survey: list[PosedImage], camera: str, encoding: str
) -> None:
    pixels = read_gray(demo.folder / "survey" / survey[5].name)
    payload = {
        "image/jpeg": files(demo, survey[5]),
        "image/png": cv2.imencode(".png", pixels)[1].tobytes(),
        "application/octet-stream": pixels.tobytes(),
    }[encoding]
    result = ask("localize", payload, encoding, camera=camera)
    truth = survey[5].cam_from_world.inverse()
    assert result["status"] == "LOCALIZED"
    assert np.linalg.norm(np.subtract(result["center"], truth.t)) < 0.02
    found = Rigid3.from_quaternion(result["rotation_wxyz"], result["center"])
    assert np.degrees(rotation_angle(found.R @ truth.R.T)) < 0.5
    assert np.linalg.eigvalsh(result["covariance"])[0] > 0


def test_an_image_is_looked_for_around_a_position(
    ask: Asker, demo: Demo, survey: list[PosedImage]
) -> None:
    image = survey[5]
    x, y, z = image.cam_from_world.center
    query = "localize", files(demo, image), "image/jpeg"
    found = ask(*query, camera="phone", position=f"{x},{y},{z}", radius_m="2")
    assert found["status"] == "LOCALIZED"
    elsewhere = ask(*query, camera="phone", position=f"{x + 100},{y},{z}", radius_m="2")
    assert (elsewhere["status"], elsewhere["reason"]) == ("LOST", "FEW_ANCHORS")


@pytest.mark.parametrize(
    "prior",
    [
        {"position": "1,2,3"},
        {"radius_m": "5"},
        {"position": "1,2", "radius_m": "5"},
        {"position": "1,2,z", "radius_m": "5"},
        {"position": "1,2,3", "radius_m": "far"},
    ],
)
def test_a_position_that_cannot_be_read_is_an_error(ask: Asker, prior: dict[str, str]) -> None:
    said = ask.error("localize", b"", "image/jpeg", camera="phone", **prior)
    assert "write both, 'x,y,z' and a number" in said


def test_an_image_that_is_not_found_is_an_answer_with_the_reason(ask: Asker) -> None:
    dark = cv2.imencode(".png", np.zeros((480, 640), np.uint8))[1].tobytes()
    result = ask("localize", dark, "image/png", camera="phone")
    assert (result["status"], result["reason"]) == ("LOST", "TOO_DARK")


@pytest.mark.parametrize(
    ("payload", "encoding", "camera", "message"),
    [
        (b"", "image/jpeg", "phone", "no JPEG or PNG"),
        (b"GIF89a", "image/png", "phone", "no JPEG or PNG"),
        (b"x", "zenoh/bytes", "phone", "encoding 'zenoh/bytes' is not supported; send image/jpeg"),
        (bytes(12), "application/octet-stream", "phone", "12 bytes are not the 640 x 480"),
        (b"", "image/jpeg", "webcam", "camera 'webcam' is not known; .* has phone"),
        (b"", "image/jpeg", "", "parameter 'camera' is missing"),
        (b"", "image/jpeg", "PINHOLE 640 480 1", "takes 4 parameters"),
        (b"", "image/jpeg", "PINHOLE 9000 480 500 500 320 240", "9000 x 480 px are too large"),
        (b"", "image/jpeg", "PINHOLE 640 480 1e-9 500 320 240", "none that there can be"),
        (b"", "image/jpeg", "PINHOLE 640 480 inf 500 320 240", "must be finite"),
        (b"", "image/jpeg", "PINHOLE 640 480 500 500 1e300 240", "none that there can be"),
    ],
)
def test_a_localize_request_that_is_wrong_is_told_why(
    ask: Asker, payload: bytes, encoding: str, camera: str, message: str
) -> None:
    assert re.search(message, ask.error("localize", payload, encoding, camera=camera))


def test_an_image_is_not_decoded_before_its_size_is_known(ask: Asker) -> None:
    bomb = cv2.imencode(".png", np.zeros((8000, 8000), np.uint8))[1].tobytes()
    said = ask.error("localize", bomb, "image/png", camera="phone")
    assert said == "the image is 8000 x 8000 px, but its camera's calibration is for 640 x 480 px"


def test_the_map_says_what_it_is(ask: Asker, demo: Demo, model: FeatureModel) -> None:
    for info in (ask("map"), ask("map", action="info"), ask("map", action="reload")):
        assert info["num_images"] == 140
        assert info["model"] == model.identity.name
    assert "action 'drop' is not known; use one of info, " in ask.error("map", action="drop")


def test_the_settings_in_force_are_what_was_read(ask: Asker, demo: Demo) -> None:
    config = ask("config")
    assert config["map"] == str(demo.map)
    assert config["localizer"]["num_anchors"] == 20
    assert "parameter 'set' is not known; use none" in ask.error("config", set="x")


def test_the_map_is_not_changed_unless_that_is_allowed(ask: Asker, demo: Demo) -> None:
    before = demo.map.read_bytes()
    for action in ("add", "remove"):
        assert "add 'change_map' to zenoh.requests.allow" in ask.error("map", action=action)
    assert demo.map.read_bytes() == before


def test_kinds_that_are_not_allowed_are_refused(demo: Demo, model: FeatureModel) -> None:
    with MapReader.open(demo.map, model.identity) as reader:
        asker = open_asker(demo.map, model, reader, RequestsConfig(allow=("config",)))
        assert "'localize' are not allowed; zenoh.requests.allow has config" in asker.error(
            "localize"
        )
        assert asker("config")["map_frame"] == "map"


def test_an_image_is_added_found_and_removed_while_the_map_is_in_use(
    ask_small: Asker, demo: Demo, survey: list[PosedImage]
) -> None:
    new = survey[60]  # of another part of the room
    query = (files(demo, new), "image/jpeg")
    info: dict[str, Any] = {}
    for image in survey[58:63]:
        info = ask_small(
            "map", files(demo, image), "image/jpeg",
            action="add", name=image.name, camera="phone",
            cam_from_world=format_pose(image.cam_from_world),
        )  # fmt: skip
    assert (info["num_images"], info["generation"]) == (17, 6)
    assert info["num_keypoints"] > 100
    found = ask_small("localize", *query, camera="phone")
    assert found["status"] == "LOCALIZED"
    assert np.linalg.norm(np.subtract(found["center"], new.cam_from_world.center)) < 0.05
    said = ask_small.error(
        "map", *query,
        action="add", name=new.name, camera="phone", cam_from_world=format_pose(new.cam_from_world),
    )  # fmt: skip
    assert "holds an image" in said
    for image in survey[58:63]:
        info = ask_small("map", action="remove", name=image.name)
    assert info["num_images"] == 12
    assert ask_small("localize", *query, camera="phone")["status"] == "LOST"
    assert "holds no image" in ask_small.error("map", action="remove", name=new.name)


def test_an_image_is_added_to_a_session(
    ask_small: Asker, demo: Demo, survey: list[PosedImage]
) -> None:
    image = survey[60]
    asked: dict[str, Any] = {"name": image.name, "camera": "phone", "session": "spring"}
    asked["cam_from_world"] = format_pose(image.cam_from_world)
    payload = (files(demo, image), "image/jpeg")
    said = ask_small.error("map", *payload, action="add", date="May 1st", **asked)
    assert "date is 'May 1st'; write 2026-01-31" in said
    without_name = {**asked, "session": ""}
    assert "1 to 100" in ask_small.error("map", *payload, action="add", **without_name)
    ask_small("map", *payload, action="add", date="2026-05-01", **asked)
    assert ask_small("map")["sessions"] == ["spring (2026-05-01)"]


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ("1 0 0 0 1 2", "write 'qw qx qy qz tx ty tz'"),
        ("1 0 0 0 1 2 here", "write 'qw qx qy qz tx ty tz'"),
        ("0 0 0 0 1 2 3", "must have length 1"),
        ("nan 0 0 0 1 2 3", "must have length 1"),
        ("1 0 0 0 1 2 nan", "too far away"),
        ("1 0 0 0 1 2 1e300", "too far away"),
    ],
)
def test_a_pose_that_is_none_is_not_added(ask_small: Asker, pose: str, message: str) -> None:
    said = ask_small.error("map", action="add", name="a", camera="phone", cam_from_world=pose)
    assert message in said
    assert ask_small("map")["num_images"] == 12


NUMBERS = st.one_of(st.floats(width=64).map(str), st.integers().map(str), st.text(max_size=4))
CAMERAS = st.one_of(
    st.just("phone"),
    st.text(max_size=20),
    st.tuples(
        st.sampled_from(["PINHOLE", "OPENCV", "OPENCV_FISHEYE", "SIMPLE_RADIAL"]),
        st.integers(-1, 70).map(str),
        st.integers(-1, 70).map(str),
        st.lists(NUMBERS, max_size=9).map(" ".join),
    ).map(" ".join),
    st.tuples(st.floats(4, 3000), st.lists(st.floats(-90, 90), min_size=4, max_size=4)).map(
        lambda p: f"OPENCV 64 48 {p[0]} {p[0]} 32 24 {' '.join(map(str, p[1]))}"
    ),
)
SMALL = np.random.default_rng(3).integers(0, 255, (48, 64), dtype=np.uint8)
PAYLOADS = st.one_of(
    st.binary(max_size=300),
    st.just(SMALL.tobytes()),
    st.sampled_from([".jpg", ".png"]).map(lambda kind: cv2.imencode(kind, SMALL)[1].tobytes()),
    st.tuples(st.sampled_from([".jpg", ".png"]), st.integers(0, 3000), st.binary(max_size=9)).map(
        lambda cut: cv2.imencode(cut[0], SMALL)[1].tobytes()[: cut[1]] + cut[2]
    ),
)
REQUESTS = st.builds(
    Request,
    kind=st.sampled_from(["localize", "map", "config", "other"]),
    parameters=st.fixed_dictionaries(
        {},
        optional={
            "action": st.sampled_from(["info", "add", "remove", "reload", "x"]),
            "camera": CAMERAS,
            "name": st.text(st.characters(exclude_categories=()), max_size=8),
            "cam_from_world": st.one_of(
                st.just("1 0 0 0 0 0 0"), st.lists(NUMBERS, min_size=6, max_size=8).map(" ".join)
            ),
            "_zenoh": st.just("1"),
            "more": st.text(max_size=3),
        },
    ),
    encoding=st.sampled_from(
        ["image/jpeg", "image/png", "application/octet-stream", "zenoh/bytes"]
    ),
    payload=PAYLOADS,
)


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(request=REQUESTS)
def test_every_request_gets_an_answer_of_one_line(ask_small: Asker, request: Request) -> None:
    answer = ask_small.responder.answer(request)
    if answer.is_error:
        text = answer.payload.decode()
        assert text
        assert "\n" not in text
        assert "the request failed" not in text  # every wrong request is known as such
    else:
        json.loads(answer.payload)


def test_what_strangers_have_put_into_the_map_does_not_end_the_localization(
    ask_small: Asker, demo: Demo, survey: list[PosedImage]
) -> None:
    """Poses and cameras that are accepted but wrong: the frame gets a pose or a reason."""
    rng = np.random.default_rng(0)
    for index in range(12):
        w, h = 640, 480
        focal = (33.0, 500.0, 31_000.0)[index % 3]
        distortion = " ".join(map(str, rng.uniform(-99, 99, 4)))
        quaternion = rng.standard_normal(4)
        numbers = (*quaternion / np.linalg.norm(quaternion), *rng.uniform(-9e7, 9e7, 3))
        ask_small(
            "map", files(demo, survey[index]), "image/jpeg", action="add", name=f"wrong{index}",
            camera=f"OPENCV {w} {h} {focal} {focal} {w / 2} {h / 2} {distortion}",
            cam_from_world=" ".join(map(str, numbers)),
        )  # fmt: skip
    for image in survey[:12:3]:
        result = ask_small("localize", files(demo, image), "image/jpeg", camera="phone")
        assert result["status"] in ("LOCALIZED", "LOST")


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def make_queue(**limits: Any) -> tuple[RequestQueue, Clock]:
    clock = Clock()
    queue = RequestQueue(RequestsConfig(**limits), lambda request: Answer(request.payload), clock)
    return queue, clock


def ignore(answer: Answer) -> None:
    pass


def test_requests_beyond_the_queue_are_told_that_it_is_busy() -> None:
    queue, _ = make_queue(max_waiting=3, max_rate_hz=1000.0)
    for _ in range(3):
        queue.put(Request("map", {}), ignore)
    with pytest.raises(RequestError, match="busy: 3 requests are waiting"):
        queue.put(Request("localize", {}), ignore)


def test_each_kind_has_its_own_rate() -> None:
    queue, clock = make_queue(max_waiting=1000, max_rate_hz=2.0)
    accepted = 0
    for tick in range(100):  # ten a second
        clock.now_s = tick / 10
        with contextlib.suppress(RequestError):
            queue.put(Request("localize", {}), ignore)
            accepted += 1
    with pytest.raises(RequestError, match="busy: at most 2 localize requests a second"):
        queue.put(Request("localize", {}), ignore)
    assert 20 <= accepted <= 23
    queue.put(Request("map", {}), ignore)


def test_a_payload_that_is_too_large_is_refused() -> None:
    queue, _ = make_queue(max_payload_bytes=10)
    with pytest.raises(RequestError, match="11 bytes; at most 10 are accepted"):
        queue.put(Request("map", {}, payload=bytes(11)), ignore)


def test_what_still_waits_at_the_end_is_told_so() -> None:
    queue, _ = make_queue()
    answers: list[Answer] = []
    queue.put(Request("map", {}), answers.append)
    queue.close()
    assert answers == [Answer(b"the daemon is stopping", is_error=True)]
    with pytest.raises(RequestError, match="stopping"):
        queue.put(Request("map", {}), ignore)


def test_requests_of_many_threads_are_all_answered() -> None:
    answers: list[bytes] = []

    async def ask_from_threads() -> None:
        queue, _ = make_queue(max_waiting=1000, max_rate_hz=1e6)
        done = asyncio.Event()
        loop = asyncio.get_running_loop()

        def reply(answer: Answer) -> None:
            answers.append(answer.payload)
            if len(answers) == 100:
                loop.call_soon_threadsafe(done.set)

        def ask(first: int) -> None:
            for number in range(first, first + 10):
                queue.put(Request("map", {}, payload=str(number).encode()), reply)

        serving = asyncio.create_task(queue.serve(asyncio.Lock()))
        threads = [threading.Thread(target=ask, args=[10 * i]) for i in range(10)]
        for thread in threads:
            thread.start()
        await asyncio.wait_for(done.wait(), 30)
        for thread in threads:
            thread.join()
        queue.close()
        await serving

    asyncio.run(ask_from_threads())
    assert sorted(answers) == sorted(str(number).encode() for number in range(100))


def test_an_answer_that_cannot_be_sent_costs_the_others_nothing() -> None:
    queue, _ = make_queue()
    answers: list[Answer] = []

    def fail(answer: Answer) -> None:
        raise OSError("the network is gone")

    async def ask_twice() -> None:
        serving = asyncio.create_task(queue.serve(asyncio.Lock()))
        answered = asyncio.Event()
        loop = asyncio.get_running_loop()

        def reply(answer: Answer) -> None:
            answers.append(answer)
            loop.call_soon_threadsafe(answered.set)

        queue.put(Request("map", {}), fail)
        queue.put(Request("map", {}), reply)
        await asyncio.wait_for(answered.wait(), 30)
        queue.close()
        await serving

    asyncio.run(ask_twice())
    assert len(answers) == 1


class Still:
    """A camera that has a frame whenever one is wanted, and so many of them."""

    live = False
    problem = ""

    def __init__(self, num_frames: int) -> None:
        self._num_frames = num_frames

    async def frames(self) -> AsyncGenerator[Captured, None]:
        for i in range(self._num_frames):
            yield Captured(Frame(np.zeros((480, 640), np.uint8), CAMERA, time_ns=i), i)

    async def close(self) -> None:
        pass


class Recorder:
    """A sink, and a responder, that write down what was done in which order."""

    problem = ""

    def __init__(self) -> None:
        self.done = ""

    def publish(self, output: Output) -> None:
        self.done += "f"

    def answer(self, request: Request) -> Answer:
        self.done += "r"
        return Answer(b"{}")

    def close(self) -> None:
        pass


def test_in_a_flood_of_requests_a_frame_waits_for_one_of_them_at_most(
    demo: Demo, model: FeatureModel
) -> None:
    recorder, answers, asked = Recorder(), list[Answer](), 0
    queue = RequestQueue(RequestsConfig(max_waiting=1000, max_rate_hz=1e9), recorder.answer)
    is_over = threading.Event()

    def flood() -> None:
        nonlocal asked
        while not is_over.is_set():
            with contextlib.suppress(RequestError):
                queue.put(Request("localize", {}), answers.append)
                asked += 1

    with MapReader.open(demo.map, model.identity) as reader:
        pipeline = Pipeline(Localizer(model, reader), reader, Rigid3.identity(), "map")
        flooding = threading.Thread(target=flood)
        flooding.start()
        try:
            asyncio.run(
                serve(Still(200), pipeline, {"recorder": recorder}, asyncio.Event(), requests=queue)
            )
        finally:
            is_over.set()
            flooding.join()
    assert recorder.done.count("f") == 200
    between = recorder.done[recorder.done.index("f") : recorder.done.rindex("f")]
    assert "r" in between
    assert "rr" not in between
    assert len(answers) == asked
