"""`graspd models wrap`: a network made elsewhere judges as it did, with the daemon's refusals."""

from __future__ import annotations

import io
import json
import re
import runpy
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

import onnx
import torch

import graspd
from graspd.models import trial
from graspd.models.contract import ModelError
from graspd.models.runtime import TactileModel
from tests.kit.inside import graspd as command
from tests.kit.inside import refused
from tests.kit.tables import write_table
from tests.models.training.samples import separable_counts

PAGE = Path(__file__).parents[4] / "deploy" / "RECORDING.md"
pytestmark = [
    pytest.mark.timeout(300),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # of torch's exporter
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with RECORDING.md's program, its network and a table of two objects."""
    made = tmp_path_factory.mktemp("wrap")
    (program,) = re.findall(r"```python\n(import io, torch\n.*?)```", PAGE.read_text(), re.DOTALL)
    (made / "net.py").write_text(program)
    counts, slipped = separable_counts(60)
    write_table(made / "own.csv", counts, slipped, ["ball", "box"] * 15 + ["box", "ball"] * 15)
    train = runpy.run_path(str(made / "net.py"))["train"]
    (made / "net.onnx").write_bytes(train(counts, slipped))
    return made


@pytest.mark.parametrize(("file", "protocol"), [("net.py", "objects"), ("net.onnx", "table")])
def test_a_wrapped_network_judges_separable_grasps_rightly(
    folder: Path, file: str, protocol: str
) -> None:
    out = folder / protocol
    done = command(
        "models", "wrap", folder / file, "--data", folder / "own.csv", "--name", "net", "--out", out
    )
    assert done.returncode == 0, done.stderr
    card = json.loads((out / "net.json").read_text())
    (measured,) = card["contract"]["measured"]
    assert (measured["protocol"], measured["f1_mean"]) == (protocol, 1.0)
    assert ("on its own table alone" in card["weak_points"][0]) == (protocol == "table")
    counts, slipped = separable_counts(60)
    seen = TactileModel(out / "net.onnx").contract.seen
    np.testing.assert_array_equal(seen.low, counts.min(axis=0))
    np.testing.assert_array_equal(seen.high, counts.max(axis=0))
    said = graspd.load(out / "net.onnx").predict(counts)
    judged = said != "unknown"
    assert judged.mean() > 0.5
    np.testing.assert_array_equal(said[judged] == "slip", slipped[judged])
    assert set(graspd.load(out / "net.onnx").predict(np.full((1, 3, 24), 2000))) == {"unknown"}


def wrapped(
    folder: Path, network: torch.nn.Module, shape: tuple[int, ...], axes: tuple[int, ...] = (0,)
) -> str:
    """Return what wrapping a network prints, or its error; `axes`: input axes of any length."""
    path = folder / "other.onnx"
    free = {"counts": {axis: f"n{axis}" for axis in axes}}
    torch.onnx.export(
        network.eval(),
        (torch.ones(shape),),
        path,
        input_names=["counts"],
        dynamic_axes=free,
        dynamo=False,
    )
    done = command("models", "wrap", path, "--data", folder / "own.csv", "--out", folder / "other")
    return done.stderr if done.returncode else done.stdout


def test_an_unusable_folder_is_refused_before_measuring(folder: Path) -> None:
    out = folder / "net.py" / "below"
    done = command("models", "wrap", "no.onnx", "--data", folder / "own.csv", "--out", out)
    assert (done.returncode, done.stderr) == (2, f"graspd: {folder / 'net.py'}: Not a directory\n")


def test_a_piped_table_is_wrapped_and_a_repeated_one_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = folder / "own.csv"
    piped = io.TextIOWrapper(io.BytesIO(table.read_bytes()))
    monkeypatch.setattr("sys.stdin", piped)
    words = "models", "wrap", folder / "net.onnx", "--name", "piped", "--out", folder / "piped"
    done = command(*words, "--data", "-")
    assert done.returncode == 0, done.stderr
    done = command(*words, "--data", table, "--data", table)
    assert done.returncode == 2
    assert f"{table}: has counts twice: the same grasp counts once" in done.stderr


def rising(*signs: float, over: int = 24, bias: float = 0.0) -> torch.nn.Linear:
    """Return a layer with an output for each sign: positive ones rise with slip, as the counts do.

    `over`: number of electrodes of the first finger whose last and first one are compared.
    """
    layer = torch.nn.Linear(72, len(signs))
    weight = torch.zeros(len(signs), 72)
    weight[:, over - 1], weight[:, 0] = 0.01 * torch.tensor(signs), -0.01 * torch.tensor(signs)
    layer.weight, layer.bias = torch.nn.Parameter(weight), torch.nn.Parameter(0.0 * weight[:, 1])
    layer.bias.data += bias
    return layer


def then(*layers: torch.nn.Module) -> torch.nn.Module:
    return torch.nn.Sequential(*layers)


RIGHT = {
    "log-odds": (rising(1.0), 100.0),
    "logits": (rising(-1.0, 1.0), 100.0),
    "probabilities": (then(rising(-1.0, 1.0), torch.nn.Softmax(1)), 100.0),
    "weak log-odds in 0..1": (then(rising(0.01, over=2, bias=0.5), torch.nn.Flatten()), 66.7),
    "one answer to all": (rising(0.0, bias=0.5), 66.7),
    "one pair of logits to all": (rising(0.0, 0.0, bias=0.2), 66.7),
}
"""Networks with their F1, %. Half of the grasps slipped: calling all of them `slip` has 2/3."""


@pytest.mark.parametrize(("network", "f1"), RIGHT.values(), ids=RIGHT)
def test_log_odds_logits_and_probabilities_are_wrapped_even_if_weak(
    folder: Path, network: torch.nn.Module, f1: float
) -> None:
    assert f"F1 {f1} % on the table itself" in wrapped(folder, network, (1, 72))


SIGMOID = "leave the last Sigmoid out"
MISREAD = {
    "slip before stable": (then(rising(1.0, -1.0), torch.nn.Softmax(1)), "(slip, stable)?"),
    "weak slip before stable": (rising(1.0, -1.0, over=4), "(slip, stable)?"),
    "stable of all": (rising(0.0, bias=-0.5), "calls every grasp of the table that slipped stable"),
    "log-odds of stable": (rising(-1.0), "log-odds of stable?"),
    "a probability": (then(rising(1.0), torch.nn.Sigmoid()), SIGMOID),
    "a constant probability": (then(rising(0.0), torch.nn.Sigmoid()), SIGMOID),
    "a reshaped one": (then(rising(0.0), torch.nn.Sigmoid(), torch.nn.Flatten()), SIGMOID),
    "a clipped one": (then(rising(0.1, bias=0.5), torch.nn.Hardtanh(0.0, 1.0)), SIGMOID),
    "two probabilities": (then(rising(-1.0, 0.5), torch.nn.Sigmoid()), "do not add up to 1"),
}


@pytest.mark.parametrize(("network", "why"), MISREAD.values(), ids=MISREAD)
def test_an_output_of_another_meaning_is_refused(
    folder: Path, network: torch.nn.Module, why: str
) -> None:
    said = wrapped(folder, network, (1, 72))
    assert said.startswith("graspd: ")
    assert why in said


class Flat(torch.nn.Linear):
    """Gives the answer to the first grasp alone, of shape (2,)."""

    def forward(self, counts: torch.Tensor) -> torch.Tensor:
        return super().forward(counts)[0]


class Deep(torch.nn.Linear):
    """Gives probabilities of shape (n, 1, 2)."""

    def forward(self, counts: torch.Tensor) -> torch.Tensor:
        return super().forward(counts).softmax(1).unsqueeze(1)


OTHERS: dict[str, tuple[torch.nn.Module, tuple[int, ...], tuple[int, ...]]] = {
    "two fingers": (torch.nn.Linear(48, 2), (1, 48), (0,)),
    "three classes": (torch.nn.Linear(72, 3), (1, 72), (0,)),
    "an answer per finger": (torch.nn.Linear(24, 2), (1, 3, 24), (0,)),
    "a batch of 32": (torch.nn.Linear(72, 2), (32, 72), ()),
    "one answer without its axis": (Flat(72, 2), (1, 72), (0,)),
    "probabilities of three axes": (Deep(72, 2), (1, 72), (0,)),
}


PROGRAMS = {
    "import torch\nimport absent_neighbour": ":2: ModuleNotFoundError: No module named 'absent_",
    "def train(counts, slipped):\n    raise ValueError('mine')": ":2: ValueError: mine\n",
    "def train(counts, slipped): ...": ": train returns NoneType, not the bytes of an ONNX file\n",
}


@pytest.mark.parametrize(("program", "why"), PROGRAMS.items())
def test_a_failing_program_is_named_with_its_line(folder: Path, program: str, why: str) -> None:
    path = folder / "failing.py"
    path.write_text(program)
    said = refused("models", "wrap", path, "--data", folder / "own.csv", "--out", folder / "none")
    assert said.startswith(f"graspd: {path}{why}")


@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
def test_a_network_of_another_shape_is_refused(
    folder: Path, other: tuple[torch.nn.Module, tuple[int, ...], tuple[int, ...]]
) -> None:
    said = wrapped(folder, *other)
    assert said.startswith("graspd: ")
    assert "must take float counts (n, 3, 24)" in said


def test_weights_in_another_file_are_refused_with_advice(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = onnx.load(folder / "net.onnx")
    path = folder / "apart.onnx"
    onnx.save_model(
        model, path, save_as_external_data=True, location="apart.data", size_threshold=0
    )
    for place in (folder, folder.parent):
        monkeypatch.chdir(place)
        done = command("models", "wrap", path, "--data", folder / "own.csv", "--out", folder)
        assert done.returncode == 2
        assert done.stderr.startswith(f"graspd: {path}: has weights in another file")
        assert "external_data=False" in done.stderr


def test_a_refusal_by_the_trial_names_the_users_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def too_slow(path: Path) -> None:
        raise ModelError(f"{path}: takes too long")

    monkeypatch.setattr(trial, "load", too_slow)
    said = wrapped(folder, rising(1.0), (1, 72))
    assert said == f"graspd: {folder / 'other.onnx'}: takes too long\n"
