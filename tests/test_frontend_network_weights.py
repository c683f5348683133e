"""Weights files: what they keep, what they refuse, and public layouts against torch networks of those layouts."""

from __future__ import annotations

import dataclasses
import json
import pickle

import numpy as np
import pytest

from improvo.cli.main import main
from improvo.errors import ConfigError, InputError
from improvo.frontend.network import load_network_frontend
from improvo.frontend.weights_files import DataSource, ModelCard, Weights, load_weights, save_weights
from network_examples import TINY, random_weights

WIDTHS = (6, 6, 6, 6, 10, 10, 10, 10)  # the public networks' pattern, narrower
HEAD, DESCRIPTOR = 12, 14


@pytest.fixture
def saved(tmp_path):
    weights = random_weights()
    path = tmp_path / "tiny.safetensors"
    save_weights(path, weights.tensors, weights.card)
    return path


def test_a_file_gives_back_tensors_and_card(tmp_path):
    card = ModelCard(
        TINY,
        licence="Apache-2.0",
        data=(DataSource("rooms", "CC BY 4.0", "A. Author"),),
        training={"stage": "homographies", "steps": 1200, "losses": [0.5, 0.25]},
        metrics={"repeatability": 0.6},
        commit="abc",
        activation_ranges={"encoder.1": 2.5},
    )
    tensors = dict(random_weights().tensors)
    path = tmp_path / "tiny.safetensors"
    save_weights(path, {**tensors, "encoder.0.norm.num_batches_tracked": np.array(7)}, card)
    weights = load_weights(path)
    assert weights.card == card
    assert weights.tensors.keys() == tensors.keys()
    assert all(np.array_equal(weights.tensors[name], tensors[name]) for name in tensors)
    assert json.loads(path.with_suffix(".json").read_text())["data"][0]["attribution"] == "A. Author"
    first = path.read_bytes()
    save_weights(path, dict(reversed(tensors.items())), card)
    assert path.read_bytes() == first


def test_bad_files_are_one_line_errors(saved, tmp_path, capsys):
    def refuse(path, message):
        with pytest.raises(InputError, match=message) as caught:
            load_weights(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)

    data = saved.read_bytes()
    for name, content in {
        "truncated": data[: len(data) // 2],
        "header": data[:20],
        "empty": b"",
        "text": b"these are no weights at all, only text",
        "pickle": pickle.dumps({"a": 1}),
    }.items():
        path = tmp_path / f"{name}.safetensors"
        path.write_bytes(content)
        refuse(path, "not a safetensors file, or truncated")
        assert main(["weights", "show", str(path)]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
    refuse(tmp_path / "absent.safetensors", "no such weights file")

    from safetensors.numpy import save_file

    save_file({"a": np.zeros(3, np.float32)}, tmp_path / "foreign.safetensors")
    refuse(tmp_path / "foreign.safetensors", "without an improvo model card")
    save_file({}, tmp_path / "card.safetensors", metadata={"improvo_model_card": '{"architecture": 3}'})
    refuse(tmp_path / "card.safetensors", "model card: architecture")


def test_tensors_of_another_architecture_are_refused(saved):
    weights = load_weights(saved)
    wider = dataclasses.replace(weights.card, architecture=dataclasses.replace(TINY, head=20))
    for card, tensors, message in (
        (wider, weights.tensors, "has shape"),
        (weights.card, {**weights.tensors, "extra": np.zeros(1, np.float32)}, "extra does not belong"),
        (weights.card, {k: v for k, v in weights.tensors.items() if "stability" not in k}, "is missing"),
        (weights.card, {**weights.tensors, "detector.1.convolution.bias": np.full(65, np.nan)}, "not finite"),
    ):
        with pytest.raises(InputError, match=message):
            save_weights(saved, tensors, card)
    assert load_weights(saved).card == weights.card  # nothing was lost
    with pytest.raises(ConfigError, match="8"):
        dataclasses.replace(TINY, encoder=(4, 4))
    with pytest.raises(InputError, match="bundled"):
        load_network_frontend("superpoint-of-nobody")


def test_folding_matches_the_definition_of_batch_norm():
    weights = random_weights()
    for normalisation in ("before_relu", "after_relu"):
        card = dataclasses.replace(weights.card, architecture=dataclasses.replace(TINY, normalisation=normalisation))
        folded = Weights(card, weights.tensors).folded()[0]
        x = np.random.default_rng(0).normal(size=(9, 4))  # inputs of one pixel's 3×3 window
        raw = weights.tensors["encoder.0.convolution.weight"].reshape(4, 9) @ x
        raw += weights.tensors["encoder.0.convolution.bias"][:, None]
        parts = ("weight", "bias", "running_mean", "running_var")
        gamma, beta, mean, var = (weights.tensors[f"encoder.0.norm.{part}"][:, None] for part in parts)

        def norm(y, gamma=gamma, beta=beta, mean=mean, var=var):
            return gamma * (y - mean) / np.sqrt(var + 1e-5) + beta

        expected = np.maximum(norm(raw), 0) if normalisation == "before_relu" else norm(np.maximum(raw, 0))
        ours = np.maximum(folded.weight.reshape(4, 9) @ x + folded.bias[:, None], 0)
        if folded.scale is not None:
            ours = ours * folded.scale[:, None] + folded.shift[:, None]
        assert (folded.scale is None) == (normalisation == "before_relu")
        np.testing.assert_allclose(ours, expected, atol=1e-5)


class PublicNetwork:
    """A public layout's names and order, run with torch's functions: what a converted file must equal."""

    def __init__(self, layout: str, seed: int = 0) -> None:
        import torch

        self.layout, self.torch, self.tensors = layout, torch, {}
        self.random = torch.Generator().manual_seed(seed)
        stages = zip((1, *WIDTHS), WIDTHS, strict=False)
        for position, (inputs, outputs) in enumerate(stages):
            self._add(self._encoder(position), inputs, outputs, 3)
        for head, outputs in (("detector", 65), ("descriptor", DESCRIPTOR)):
            self._add(self._head(head, 0), WIDTHS[-1], HEAD, 3)
            self._add(self._head(head, 1), HEAD, outputs, 1)

    def _encoder(self, position: int) -> tuple[str, str]:
        stage, half = divmod(position, 2)
        if self.layout == "after":
            return f"backbone.{stage}.{half}.conv", f"backbone.{stage}.{half}.bn"
        if self.layout == "before":
            stage_name = "inc.conv" if stage == 0 else f"down{stage}.mpconv.1"
            return f"{stage_name}.conv.{3 * half}", f"{stage_name}.conv.{3 * half + 1}"
        return f"conv{stage + 1}{'ab'[half]}", ""

    def _head(self, head: str, part: int) -> tuple[str, str]:
        if self.layout == "after":
            return f"{head}.{part}.conv", f"{head}.{part}.bn"
        name = ("P" if head == "detector" else "D") + "ab"[part]
        return f"conv{name}", f"bn{name}" if self.layout == "before" else ""

    def _add(self, names: tuple[str, str], inputs: int, outputs: int, kernel: int) -> None:
        convolution, norm = names
        scale = (2 / (inputs * kernel**2)) ** 0.5
        shape = (outputs, inputs, kernel, kernel)
        self.tensors[f"{convolution}.weight"] = self.torch.randn(shape, generator=self.random) * scale
        self.tensors[f"{convolution}.bias"] = self.torch.randn(outputs, generator=self.random) * 0.1
        if norm:
            for part, offset in (("weight", 0.5), ("bias", -0.5), ("running_mean", -0.5), ("running_var", 0.5)):
                self.tensors[f"{norm}.{part}"] = self.torch.rand(outputs, generator=self.random) + offset
            self.tensors[f"{norm}.num_batches_tracked"] = self.torch.tensor(5)

    def _layer(self, x, names: tuple[str, str], relu: bool):
        functional, (convolution, norm) = self.torch.nn.functional, names
        weight = self.tensors[f"{convolution}.weight"]
        x = functional.conv2d(x, weight, self.tensors[f"{convolution}.bias"], padding=weight.shape[-1] // 2)
        steps = [functional.relu] if relu else []
        if norm:
            mean, var, gamma, beta = (
                self.tensors[f"{norm}.{part}"] for part in ("running_mean", "running_var", "weight", "bias")
            )
            epsilon = 1e-3 if self.layout == "after" else 1e-5
            batch_norm = [lambda y: functional.batch_norm(y, mean, var, gamma, beta, eps=epsilon)]
            steps = steps + batch_norm if self.layout == "after" else batch_norm + steps
        for step in steps:
            x = step(x)
        return x

    def __call__(self, x):
        for position in range(8):
            x = self._layer(x, self._encoder(position), relu=True)
            if position in (1, 3, 5):
                x = self.torch.nn.functional.max_pool2d(x, 2)
        return [
            self._layer(self._layer(x, self._head(head, 0), relu=True), self._head(head, 1), relu=False)
            for head in ("detector", "descriptor")
        ]


@pytest.mark.parametrize("layout", ["none", "before", "after"])
@pytest.mark.parametrize("container", ["bare.pth", "checkpoint.pth", "bare.safetensors"])
def test_public_layouts_are_converted_exactly(tmp_path, capsys, layout, container):
    torch = pytest.importorskip("torch")
    public = PublicNetwork(layout)
    source, target = tmp_path / container, tmp_path / "ours.safetensors"
    if container == "bare.safetensors":
        from safetensors.torch import save_file

        save_file(public.tensors, source)
    elif container == "checkpoint.pth":
        wrapped = {f"module.{name}": values for name, values in public.tensors.items()}
        torch.save({"n_iter": 170000, "model_state_dict": wrapped, "loss": torch.tensor(0.5)}, source)
    else:
        torch.save(public.tensors, source)
    assert main(["weights", "import", str(source), "-o", str(target)]) == 0
    assert "non-commercial" in capsys.readouterr().out

    frontend = load_network_frontend(target)
    architecture = frontend.weights.architecture
    assert (architecture.encoder, architecture.head, architecture.descriptor) == (WIDTHS, HEAD, DESCRIPTOR)
    assert not architecture.stability
    image = torch.rand((1, 1, 40, 56), generator=torch.Generator().manual_seed(1))
    maps = frontend.runtime(image.numpy())
    logits, descriptors = public(image)
    heat = torch.nn.functional.pixel_shuffle(torch.softmax(logits, 1)[:, :64], 8)[:, 0].numpy()
    np.testing.assert_allclose(maps.heat, heat, atol=1e-6)
    np.testing.assert_allclose(maps.descriptors, descriptors.permute(0, 2, 3, 1).numpy(), atol=1e-5)
    features = frontend((image[0, 0].numpy() * 255).astype(np.uint8))
    assert len(features) > 0
    assert features.stability is None
    with pytest.raises(InputError, match="no stability head"):
        frontend.stability_map(np.zeros((16, 16), np.uint8))


def test_import_refuses_what_it_does_not_know(tmp_path, capsys):
    torch = pytest.importorskip("torch")
    public = PublicNetwork("before")
    missing = {name: values for name, values in public.tensors.items() if name != "bnDb.running_var"}
    bent = {**public.tensors, "convDa.weight": torch.zeros(HEAD + 1, WIDTHS[-1], 3, 3)}
    torch.save(missing, tmp_path / "missing.pth")
    torch.save(bent, tmp_path / "bent.pth")
    plain = PublicNetwork("none").tensors
    normed = {**plain, **{f"bn3a.{part}": torch.ones(WIDTHS[4]) for part in ("weight", "bias", "running_mean")}}
    torch.save(normed, tmp_path / "normed.pth")
    torch.save({"fc.weight": torch.zeros(3)}, tmp_path / "other.pth")
    torch.save([1, 2], tmp_path / "list.pth")
    (tmp_path / "evil.pth").write_bytes(pickle.dumps(_Evil()))
    (tmp_path / "text.pth").write_text("no weights")
    for name, message in {
        "missing.pth": "bnDb.running_var is missing",
        "bent.pth": "has shape",
        "normed.pth": "it has `bn3a.running_mean`; fold its batch norm into the convolutions",
        "other.pth": "not a SuperPoint layout",
        "list.pth": "not a state_dict",
        "evil.pth": "not readable as a file of tensors",
        "text.pth": "not readable as a file of tensors",
        "absent.pth": "no such file",
    }.items():
        assert main(["weights", "import", str(tmp_path / name), "-o", str(tmp_path / "out.safetensors")]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert len(error.splitlines()) == 1
    assert not list(tmp_path.glob("out*"))
    assert not list(tmp_path.glob("was-here"))


class _Evil:
    def __reduce__(self):
        return (exec, ("raise SystemExit('a pickle was executed')",))


def test_calibration_is_kept_in_the_file(saved, tmp_path, capsys):
    import cv2

    folder = tmp_path / "pictures"
    folder.mkdir()
    random = np.random.default_rng(0)
    for number in range(4):
        cv2.imwrite(str(folder / f"{number}.png"), random.integers(0, 256, (48, 64), np.uint8))
    (folder / "broken.png").write_bytes(b"no picture")
    target = tmp_path / "calibrated.safetensors"
    assert main(["weights", "calibrate", str(saved), str(folder), "-o", str(target)]) == 0
    printed = capsys.readouterr().out
    assert "skipped 1" in printed
    assert "broken.png" in printed
    assert "over 4 pictures" in printed
    assert all(value > 0 for value in load_weights(target).card.activation_ranges.values())
    assert load_network_frontend(target).runtime.name == "openvino-int8"
    assert main(["weights", "calibrate", str(saved), str(folder), "-o", str(target)]) == 2
    assert "exists already" in capsys.readouterr().err
    empty = tmp_path / "empty"
    empty.mkdir()
    assert main(["weights", "calibrate", str(saved), str(empty), "-o", str(tmp_path / "no.safetensors")]) == 2
    assert "no pictures" in capsys.readouterr().err


def test_the_card_is_printed(saved, capsys):
    assert main(["weights", "show", str(saved)]) == 0
    assert json.loads(capsys.readouterr().out)["architecture"]["name"] == "tiny"


@pytest.mark.parametrize("prefix", ["module.", "superpoint.", "extractor.", "model.net."])
def test_import_finds_the_layout_behind_any_prefix(prefix: str) -> None:
    from improvo.frontend.importing import LAYOUTS, convert

    encoder = [(64, 1), (64, 64), (64, 64), (64, 64), (128, 64), (128, 128), (128, 128), (128, 128)]
    sizes = [*encoder, (256, 128), (65, 256), (256, 128), (256, 256)]
    tensors = {}
    for position, (name, _) in enumerate(LAYOUTS[0].names.values()):
        outs, ins = sizes[position]
        kernel = 1 if position in (9, 11) else 3
        tensors[f"{prefix}{name}.weight"] = np.full((outs, ins, kernel, kernel), 0.01, np.float32)
        tensors[f"{prefix}{name}.bias"] = np.zeros(outs, np.float32)
    tensors["optimiser.step"] = np.zeros(1)
    weights, layout = convert(tensors, "lightning.ckpt", "mine")
    assert layout is LAYOUTS[0]
    assert weights.card.architecture.descriptor == 256
    with pytest.raises(InputError, match="holds 2 networks"):
        convert(tensors | {f"teacher.{name.removeprefix(prefix)}": v for name, v in tensors.items()}, "x", "mine")
