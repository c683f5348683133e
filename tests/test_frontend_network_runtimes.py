"""The runtimes against each other: OpenVINO, torch, int8, and the exported ONNX file in ONNX Runtime."""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.cli.main import main
from improvo.errors import ConfigError, InputError
from improvo.frontend.architecture import ARCHITECTURES
from improvo.frontend.int8 import ACTIVATION_MAX, spread_over_copies, weight_max
from improvo.frontend.network import NetworkFrontend, prepare
from improvo.frontend.quantisation import calibrate
from improvo.frontend.settings import NetworkSettings
from improvo.frontend.weights_files import Weights, save_weights
from network_examples import TINY, lit_pixel_weights, random_weights

LAYOUTS = ("none", "before_relu", "after_relu")
# Largest difference between float32 runtimes, relative to the largest value of the map.
TOLERANCE = 1e-5


def picture(height: int = 101, width: int = 133, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (height, width), np.uint8)
    return cv2.GaussianBlur(noise, (5, 5), 1)


@pytest.mark.parametrize("normalisation", LAYOUTS)
def test_openvino_agrees_with_torch(normalisation):
    pytest.importorskip("torch")
    weights = random_weights(dataclasses.replace(TINY, normalisation=normalisation))
    openvino = NetworkFrontend(weights)
    torch = NetworkFrontend(weights, NetworkSettings(runtime="torch"))
    assert openvino.runtime.name == "openvino-float32"
    assert torch.runtime.name == "torch-cpu-float32"
    images = np.stack([prepare(picture(seed=seed)) for seed in (0, 1)])[:, None]
    for ours, theirs in zip(openvino.runtime(images), torch.runtime(images), strict=True):
        assert ours.shape == theirs.shape
        assert np.std(theirs) > 0
        np.testing.assert_allclose(ours, theirs, atol=TOLERANCE * np.abs(theirs).max())


@pytest.mark.parametrize("normalisation", LAYOUTS)
def test_onnx_runtime_agrees_with_openvino(normalisation):
    pytest.importorskip("onnxruntime")
    weights = random_weights(dataclasses.replace(TINY, normalisation=normalisation))
    openvino, onnx = (NetworkFrontend(weights, NetworkSettings(runtime=name)) for name in ("openvino", "onnxruntime"))
    assert onnx.runtime.name == "onnxruntime-float32"
    images = np.stack([prepare(picture(seed=seed)) for seed in (0, 1)])[:, None]
    for ours, theirs in zip(openvino.runtime(images), onnx.runtime(images), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=TOLERANCE * np.abs(theirs).max())


def test_onnx_runtime_has_eight_bits_too():
    pytest.importorskip("onnxruntime")
    from improvo.frontend import runtime_onnxruntime, runtime_openvino

    weights = random_weights(dataclasses.replace(TINY, encoder=(16,) * 8, head=32))
    calibrated = calibrate(weights, [picture(seed=seed) for seed in range(5)])
    image = prepare(picture(seed=7))[None, None]
    onnx, openvino, exact = (
        NetworkFrontend(calibrated, NetworkSettings(runtime=runtime, precision=precision)).runtime
        for runtime, precision in (("onnxruntime", "auto"), ("openvino", "int8"), ("openvino", "float32"))
    )
    assert onnx.name == "onnxruntime-int8"
    a, b, c = (runtime(image).descriptors[0].copy() for runtime in (onnx, openvino, exact))
    assert not np.array_equal(a, c)
    narrow = runtime_onnxruntime.loses_large_products() or runtime_openvino.loses_large_products()
    assert np.median(cosines(a, b)) > (0.997 if narrow else 0.999)
    assert np.median(cosines(a, c)) > (0.997 if narrow else 0.999)


@pytest.mark.parametrize("runtime", ["openvino", "onnxruntime"])
def test_no_product_of_eight_bits_is_too_large_for_the_processor(runtime):
    """Without VNNI two products are added in sixteen bits; with the largest weights and inputs half would be lost."""
    pytest.importorskip(runtime)
    weights = random_weights(dataclasses.replace(TINY, encoder=(16,) * 8, head=32))
    positive = {name: np.full_like(one, 0.01) if one.ndim == 4 else one for name, one in weights.tensors.items()}
    white = np.full((64, 64), 255, np.uint8)
    calibrated = calibrate(Weights(weights.card, positive), [white])
    rounded, exact = (
        NetworkFrontend(calibrated, NetworkSettings(runtime=runtime, precision=precision)).runtime
        for precision in ("int8", "float32")
    )
    maps = [one(prepare(white)[None, None]).descriptors[0, 3:5, 3:5].copy() for one in (rounded, exact)]
    np.testing.assert_allclose(maps[0], maps[1], rtol=0.03)


def test_weights_are_narrow_where_products_would_be_lost():
    assert [weight_max(False), weight_max(True)] == [127, 63]
    assert 2 * ACTIVATION_MAX * weight_max(True) < 2**15 < 2 * ACTIVATION_MAX * weight_max(False)
    first = np.linspace(-1, 1, 18, dtype=np.float32).reshape(2, 1, 3, 3)
    for largest in (127, 63):
        spread = spread_over_copies(first, largest)
        np.testing.assert_allclose(spread.sum(axis=1), first[:, 0], atol=1 / (8 * largest) + 1e-6)


def test_both_runtimes_measure_the_same_activation_ranges():
    pytest.importorskip("onnxruntime")
    from improvo.frontend import runtime_onnxruntime, runtime_openvino

    weights, image = random_weights(), prepare(picture())[None, None]
    ours, theirs = (each.activation_ranges(weights, image, 0.999) for each in (runtime_openvino, runtime_onnxruntime))
    assert list(ours) == list(theirs)
    np.testing.assert_allclose(list(ours.values()), list(theirs.values()), rtol=1e-5)


@pytest.mark.parametrize(
    ("absent", "answer"), [("'openvino'", "onnxruntime-float32"), ("'openvino', 'onnxruntime'", "improvo[onnxruntime]")]
)
def test_without_openvino_onnx_runtime_takes_its_place(tmp_path, absent, answer):
    pytest.importorskip("onnxruntime")
    path = tmp_path / "tiny.safetensors"
    weights = random_weights()
    save_weights(path, weights.tensors, weights.card)
    program = f"""
import sys
for name in ({absent},):
    sys.modules[name] = None
import numpy as np
from improvo.errors import MissingExtraError
from improvo.frontend.network import load_network_frontend
try:
    frontend = load_network_frontend({str(path)!r}, max_keypoints=7, border=2)
    assert len(frontend(np.random.default_rng(0).random((40, 50)))) == 7
    print(frontend.runtime.name)
except MissingExtraError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    assert answer in done.stdout


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity") or os.cpu_count() == 1, reason="nothing to pin to")
def test_a_network_with_one_thread_stays_on_no_core():
    """Several processes would all be on the first."""
    frontend = NetworkFrontend(random_weights(TINY), NetworkSettings(threads=1))
    images = np.zeros((1, 1, 480, 640), np.float32)
    computing, ended, found = threading.get_native_id(), threading.Event(), set()

    def watch() -> None:
        while not ended.wait(0.0002):
            found.add(frozenset(os.sched_getaffinity(computing)))

    watcher = threading.Thread(target=watch)
    watcher.start()
    for _ in range(20):
        frontend.runtime(images)
    ended.set()
    watcher.join()
    assert found == {frozenset(os.sched_getaffinity(computing))}


def cosines(a, b):
    return (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)


def test_the_unfolded_network_agrees_too():
    torch = pytest.importorskip("torch")
    from improvo.frontend.runtime_torch import load_network
    from improvo.frontend.superpoint import heat_map

    weights = random_weights()
    image = prepare(picture())[None, None]
    with torch.inference_mode():
        output = load_network(weights)(torch.from_numpy(image))
        heat = heat_map(output.detector_logits).numpy()
    maps = NetworkFrontend(weights).runtime(image)
    np.testing.assert_allclose(maps.heat, heat, atol=TOLERANCE * heat.max())
    np.testing.assert_allclose(
        maps.descriptors, output.descriptors.permute(0, 2, 3, 1).numpy(), atol=1e-5 * output.descriptors.abs().max()
    )


def test_parameter_counts():
    torch = pytest.importorskip("torch")
    from improvo.frontend.superpoint import SuperPoint

    def count(architecture):
        return sum(values.numel() for values in SuperPoint(architecture, batch_norm=False).parameters())

    paper, small = ARCHITECTURES["superpoint"], ARCHITECTURES["superpoint-small"]
    assert count(dataclasses.replace(paper, stability=False)) == 1_300_865  # the published SuperPoint
    assert count(paper) == 1_300_865 + (128 * 9 + 1) * 256 + (256 + 1) * 2
    assert count(small) == 404_067
    output = SuperPoint(paper)(torch.zeros(1, 1, 16, 24))
    assert [tuple(maps.shape) for maps in output] == [(1, 65, 2, 3), (1, 256, 2, 3), (1, 2, 2, 3)]
    with pytest.raises(ValueError, match="multiples of 8"):
        SuperPoint(small)(torch.zeros(1, 1, 17, 24))


def test_multiplications_are_counted_as_torch_counts_them():
    torch = pytest.importorskip("torch")
    from torch.utils.flop_counter import FlopCounterMode

    from improvo.frontend.superpoint import SuperPoint

    with FlopCounterMode(display=False) as counter, torch.inference_mode():
        SuperPoint(TINY, batch_norm=False)(torch.zeros(1, 1, 40, 64))
    assert 2 * TINY.multiplications(37, 63) == counter.get_total_flops()


def test_same_image_same_features_and_batches_are_single_images():
    frontend = NetworkFrontend(random_weights())
    images = [picture(seed=seed) for seed in range(3)]
    single = [frontend(image) for image in images]
    for one, other in zip(single, NetworkFrontend(random_weights()).batch(images), strict=True):
        assert len(one) > 20
        np.testing.assert_allclose(one.keypoints, other.keypoints, atol=1e-3)
        np.testing.assert_allclose(one.descriptors, other.descriptors, atol=1e-5)
    again = frontend(images[0])
    for field in dataclasses.fields(again):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(single[0], field.name))
    assert (np.diff(again.scores) <= 0).all()
    np.testing.assert_allclose(np.linalg.norm(again.descriptors, axis=1), 1, atol=1e-5)
    assert frontend.batch([]) == []
    with pytest.raises(InputError, match="one size"):
        frontend.batch([images[0], images[0][:50]])


def test_features_of_an_earlier_call_survive_the_next():
    frontend = NetworkFrontend(random_weights())
    first = frontend(picture())
    kept = [np.copy(getattr(first, field.name)) for field in dataclasses.fields(first)]
    heat = frontend.heat_map(picture())
    kept_heat = heat.copy()
    frontend(picture(seed=9))
    for field, values in zip(dataclasses.fields(first), kept, strict=True):
        np.testing.assert_array_equal(getattr(first, field.name), values)
    np.testing.assert_array_equal(heat, kept_heat)


def test_int8_stays_close_once_calibrated():
    weights = random_weights(dataclasses.replace(TINY, encoder=(16,) * 8, head=32))
    with pytest.raises(ConfigError, match="calibrate"):
        NetworkFrontend(weights, NetworkSettings(precision="int8"))
    calibrated = calibrate(weights, [picture(seed=seed) for seed in range(5)])
    int8, float32 = NetworkFrontend(calibrated), NetworkFrontend(calibrated, NetworkSettings(precision="float32"))
    assert (int8.runtime.name, float32.runtime.name) == ("openvino-int8", "openvino-float32")
    image = prepare(picture(seed=7))[None, None]
    a, b = int8.runtime(image).descriptors[0], float32.runtime(image).descriptors[0]
    assert not np.array_equal(a, b)
    cosine = (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
    assert np.median(cosine) > 0.999


def test_int8_refuses_what_it_cannot_run():
    with pytest.raises(InputError, match="at least one image"):
        calibrate(random_weights(), [])
    with pytest.raises(InputError, match="after the ReLU"):
        calibrate(random_weights(dataclasses.replace(TINY, normalisation="after_relu")), [picture()])


@pytest.mark.parametrize("settings", [{"precision": "float16"}, {"runtime": "torch", "precision": "int8"}])
def test_precisions_that_a_runtime_lacks_are_refused(settings):
    pytest.importorskip("torch")
    with pytest.raises(ConfigError, match="precision"):
        NetworkFrontend(random_weights(), NetworkSettings(**settings))


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
@pytest.mark.parametrize("order", ["first, second", "second, first"])
def test_a_signal_after_networks_were_dropped_reaches_its_handler(order):
    program = f"""
import gc, os, signal
import numpy as np
from improvo.frontend.network import NetworkFrontend
from network_examples import random_weights
first, second = (NetworkFrontend(random_weights()) for _ in range(2))
for each in (first, second):
    each(np.zeros((40, 48), np.uint8))
del each
for name in {order!r}.split(", "):
    del globals()[name]
    gc.collect()
signal.signal(signal.SIGTERM, lambda number, frame: print("handled"))
os.kill(os.getpid(), signal.SIGTERM)
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, f"ended with {done.returncode}"
    assert "handled" in done.stdout


def test_all_networks_share_one_core():
    from improvo.frontend import openvino_library, runtime_openvino

    sources = [Path(module.__file__).read_text() for module in (openvino_library, runtime_openvino)]
    assert [source.count("Core()") for source in sources] == [1, 0]


def test_inference_needs_no_torch(tmp_path):
    path = tmp_path / "tiny.safetensors"
    weights = random_weights()
    save_weights(path, weights.tensors, weights.card)
    program = f"""
import sys
sys.modules["torch"] = sys.modules["onnx"] = None
import numpy as np
from improvo.frontend.network import load_network_frontend
features = load_network_frontend({str(path)!r}, max_keypoints=7, border=2)(np.random.default_rng(0).random((40, 50)))
assert len(features) == 7, len(features)
"""
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize("normalisation", LAYOUTS)
@pytest.mark.parametrize("subpixel_radius", [0, 2])
def test_exported_onnx_gives_the_same_features(tmp_path, normalisation, subpixel_radius):
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    weights = random_weights(dataclasses.replace(TINY, normalisation=normalisation))
    save_weights(tmp_path / "tiny.safetensors", weights.tensors, weights.card)
    options = ["--max-keypoints", "400", "--subpixel-radius", str(subpixel_radius), "--threshold", "0.01"]
    assert main(["export", "onnx", str(tmp_path / "tiny.safetensors"), "-o", str(tmp_path / "m.onnx"), *options]) == 0
    settings = NetworkSettings(max_keypoints=400, subpixel_radius=subpixel_radius, corner_radius=0, threshold=0.01)
    frontend = NetworkFrontend(weights, settings)
    session = runtime.InferenceSession(tmp_path / "m.onnx", providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    for size in ((101, 133), (64, 80)):
        images = [picture(*size, seed=seed) for seed in (3, 4)]
        batch = (np.stack(images)[:, None] / 255).astype(np.float32)
        found = dict(zip(names, session.run(None, {"image": batch}), strict=True))
        for row, image in enumerate(images):
            expected = frontend(image)
            count = len(expected)
            assert 20 < count < 400
            assert found["valid"][row].sum() == count
            assert found["valid"][row, :count].all()
            order = np.lexsort(expected.keypoints.T)
            theirs = np.lexsort(found["keypoints"][row, :count].T)
            np.testing.assert_allclose(
                found["keypoints"][row, theirs], expected.keypoints[order], atol=1e-3 if subpixel_radius else 0
            )
            for name in ("scores", "descriptors", "stability"):
                np.testing.assert_allclose(found[name][row, theirs], getattr(expected, name)[order], atol=1e-4)


def test_exported_onnx_finds_lit_pixels(tmp_path):
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    from improvo.export.onnx import export_onnx

    export_onnx(
        lit_pixel_weights(), tmp_path / "m.onnx", NetworkSettings(max_keypoints=5, subpixel_radius=0, corner_radius=0)
    )
    session = runtime.InferenceSession(tmp_path / "m.onnx", providers=["CPUExecutionProvider"])
    image = np.zeros((1, 1, 37, 51), np.float32)
    image[0, 0, [7, 30], [13, 41]] = 1
    image[0, 0, 36, 50] = 1  # in the border
    keypoints, valid = session.run(["keypoints", "valid"], {"image": image})
    assert sorted(map(tuple, keypoints[valid].tolist())) == [(13, 7), (41, 30)]


@pytest.mark.skipif(not hasattr(cv2, "ALIKED"), reason="cv2.ALIKED came with OpenCV 5: pip install -U opencv-python")
@pytest.mark.parametrize("size", [(101, 133), (64, 80)])
def test_opencv_loads_the_exported_onnx_as_a_feature2d(tmp_path, size):
    pytest.importorskip("onnx")
    weights = random_weights()
    save_weights(tmp_path / "tiny.safetensors", weights.tensors, weights.card)
    target, options = str(tmp_path / "m.onnx"), ["--max-keypoints", "400", "--threshold", "0.01", "--layout", "opencv"]
    assert main(["export", "onnx", str(tmp_path / "tiny.safetensors"), "-o", target, *options]) == 0
    image = picture(*size)
    parameters = cv2.ALIKED_Params()
    parameters.inputSize = image.shape[::-1]
    detector = cv2.ALIKED.create(target, parameters)
    found, descriptors = detector.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), None)
    expected = NetworkFrontend(weights, NetworkSettings(max_keypoints=400, corner_radius=0, threshold=0.01))(image)
    assert 20 < len(expected) < 400
    assert len(found) == len(expected)
    places = np.array([keypoint.pt for keypoint in found])
    theirs, ours = np.lexsort(np.round(places, 1).T), np.lexsort(np.round(expected.keypoints, 1).T)
    np.testing.assert_allclose(places[theirs], expected.keypoints[ours], atol=1e-3)
    np.testing.assert_allclose(descriptors[theirs], expected.descriptors[ours], atol=1e-4)
    scores = np.array([keypoint.response for keypoint in found])
    np.testing.assert_allclose(scores[theirs], expected.scores[ours], atol=1e-4)


TURKISH = """
import locale
import sys

import numpy as np

import improvo

if len(sys.argv) > 1:
    assert locale.setlocale(locale.LC_ALL, "tr_TR.UTF-8")
picture = np.random.default_rng(0).integers(0, 255, (64, 72)).astype(np.uint8)
for precision in ("float32", "int8"):
    options = improvo.NetworkOptions(runtime="openvino", precision=precision, threads=1)
    print(improvo.load_frontend("superpoint-small", 50, network=options)(picture).keypoints.tolist())
if len(sys.argv) > 1:
    print(locale.setlocale(locale.LC_ALL), file=sys.stderr)
"""


@pytest.mark.skipif(shutil.which("localedef") is None, reason="needs localedef, of the C library's own tools")
def test_a_turkish_user_gets_the_same_keypoints(tmp_path: Path) -> None:
    """In Turkish `i` is not the small letter of `I`, which OpenVINO trips over in the names of its options."""
    made = subprocess.run(
        ["localedef", "-i", "tr_TR", "-f", "UTF-8", str(tmp_path / "tr_TR.UTF-8")], capture_output=True
    )
    if made.returncode > 1 or not (tmp_path / "tr_TR.UTF-8").exists():
        pytest.skip("needs the sources of the C library's locales")
    environment = {**os.environ, "LOCPATH": str(tmp_path), "LC_ALL": "tr_TR.UTF-8"}
    turkish = subprocess.run(
        [sys.executable, "-c", TURKISH, "all"], capture_output=True, text=True, env=environment, check=True
    )
    plain = subprocess.run([sys.executable, "-c", TURKISH], capture_output=True, text=True, check=True)
    assert turkish.stdout == plain.stdout
    assert len(plain.stdout.splitlines()) == 2
    assert turkish.stderr.strip().endswith("tr_TR.UTF-8")  # the user's own again
