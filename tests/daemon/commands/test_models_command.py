"""`graspd models`: what a user reads before choosing one."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import pytest

from graspd.daemon.assembly import assembly
from graspd.daemon.scene import Scene, parse
from graspd.models import own, zoo
from graspd.models.contract import ModelError
from graspd.models.runtime import read
from tests.kit.inside import graspd
from tests.kit.scenes import demo_scene


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Of a user who has added nothing yet, on a computer where nobody has."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(own, "SYSTEM_FOLDER", tmp_path / "system" / "models")
    return tmp_path / "home"


@pytest.fixture
def trained(tmp_path: Path) -> Path:
    """What `graspd train` leaves behind: a model and its card."""
    folder = tmp_path / "runs"
    folder.mkdir()
    shutil.copy(zoo.find("mlp").with_suffix(".json"), folder / "mine.json")
    return Path(shutil.copy(zoo.find("mlp"), folder / "mine.onnx"))


command = partial(graspd, "models")


def done(*words: object) -> str:
    """What a command that succeeds prints."""
    result = command(*words)
    assert result.returncode == 0, result.stderr
    return result.stdout


def refused(says: str, *words: object) -> None:
    result = command(*words)
    assert result.returncode == 2
    assert says in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("name", zoo.names())
def test_a_card_says_what_a_model_is_worth_and_where_it_ends(name: str) -> None:
    result = graspd("models", name)
    assert result.returncode == 0, result.stderr
    card = zoo.card(name)
    assert card["what"] in result.stdout
    for point in card["weak_points"]:
        assert point in result.stdout
    assert f"made by: graspd train {name} --data DIR" in result.stdout
    assert "licence of the data: MIT" in result.stdout
    assert json.loads(graspd("models", name, "--json").stdout) == card


def scene_with(name: str, fingers: tuple[str, ...] = ("ff", "mf", "th")) -> Scene:
    replay = {"driver": "replay", "recordings": ["x.csv"]}
    hand, model = {"fingers": list(fingers)}, {"name": name}
    return parse({"tactile": replay, "hand": hand, "model": model}, Path("scene.toml"))


def test_an_added_model_is_found_by_its_name_until_it_is_removed(home: Path, trained: Path) -> None:
    told = done("add", trained, "--name", "mine", "--user")
    kept = home / ".local" / "share" / "graspd" / "models" / "mine.onnx"
    assert told == f'{kept}: added; in a scene, below [model]: name = "mine"\n'
    assert kept.read_bytes() == trained.read_bytes()
    assert sorted(path.name for path in kept.parent.iterdir()) == ["mine.json", "mine.onnx"]
    assert kept.stat().st_mode & 0o777 == 0o644
    assert assembly.model_path(scene_with("mine")) == kept
    assert assembly.load_model(scene_with("mine")).sha256 == read(trained).sha256
    listing = done()
    assert "mine (own)  " in listing
    assert f"mine: {zoo.card('mlp')['what']} ({kept})" in listing
    done("add", trained, "--name", "a" * 40, "--user")
    assert f"{'a' * 40} (own)  ff mf th  " in done()  # columns do not touch
    done("remove", "a" * 40, "--user")
    assert json.loads(done("mine", "--json")) == zoo.card("mlp")
    done("remove", "mine", "--user")
    assert not list(kept.parent.iterdir())
    with pytest.raises(ModelError, match=f"no model 'mine' .*{kept.parent}"):
        assembly.model_path(scene_with("mine"))


def test_check_names_an_added_model_as_the_scene_does(
    home: Path, trained: Path, tmp_path: Path
) -> None:
    done("add", trained, "--name", "mine", "--user")
    for name, said in (("mine", "mine, trained as mlp ("), ("mlp", "mlp (")):
        scene = demo_scene(tmp_path, sections=f'[model]\nname = "{name}"')
        result = graspd("check", scene, "--json")
        assert result.returncode == 0, result.stderr
        assert json.loads(result.stdout)["in"]["model"].startswith(said)


def test_a_model_without_a_card_is_shown_and_kept_by_its_contract(
    home: Path, trained: Path
) -> None:
    trained.with_suffix(".json").unlink()
    shown = done(trained)
    assert shown.startswith("mlp: no card came with it\n")
    assert f"F1 {100 * zoo.card('mlp')['contract']['measured'][0]['f1_mean']:.1f} +- " in shown
    done("add", trained, "--name", "mine", "--user")
    assert "mlp: no card came with it\n" in done("mine")
    done()


def test_the_users_model_comes_before_the_systems(home: Path, trained: Path) -> None:
    done("add", trained, "--name", "mine", "--system")
    assert own.find("mine") == own.SYSTEM_FOLDER / "mine.onnx"
    assert own.SYSTEM_FOLDER.stat().st_mode & 0o777 == 0o755
    done("add", trained, "--name", "mine", "--user")
    assert own.find("mine").is_relative_to(home)
    again = command("add", trained, "--name", "mine", "--system", "--force")
    assert (again.returncode, "this name too, and comes first for you" in again.stderr) == (0, True)
    done("remove", "mine", "--user")
    assert own.find("mine") == own.SYSTEM_FOLDER / "mine.onnx"


def test_nothing_shadows_a_model_that_ships_with_graspd(home: Path, trained: Path) -> None:
    folder = home / ".local" / "share" / "graspd" / "models"
    folder.mkdir(parents=True)
    for name in ("small-session", "small-session-ff-rf"):
        shutil.copy(trained, folder / f"{name}.onnx")
    assert own.find("small-session") == zoo.find("small-session")
    assert "small-session" not in own.added()
    wanted = scene_with("small-session", ("ff", "rf"))
    assert assembly.model_path(wanted) == zoo.find("small-session")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--name", "small-session"], "graspd ships a model 'small-session'"),
        ([], "graspd ships a model 'mlp'"),
        (["--name", "../mine"], "'../mine' is no name for a model"),
        (["--name", "mine.onnx"], "'mine.onnx' is no name for a model"),
        (["--name", "add"], "'add' is no name for a model"),
    ],
)
def test_a_name_that_cannot_be_is_refused(
    words: list[str], says: str, home: Path, trained: Path
) -> None:
    refused(says, "add", trained, "--user", *words)
    assert not home.exists()


def test_what_the_daemon_would_refuse_is_not_added(home: Path, trained: Path) -> None:
    add = ("add", trained, "--name", "mine", "--user")
    whole, card = trained.read_bytes(), trained.with_suffix(".json").read_text()
    trained.with_suffix(".json").unlink()
    trained.write_bytes(whole[:-100])
    refused("not a usable ONNX model", *add)
    trained.with_suffix(".json").write_text(card)
    shutil.copy(zoo.find("svm"), trained)
    refused("mine.json: is the card of another file than mine.onnx", *add)
    trained.write_bytes(whole)
    trained.with_suffix(".json").write_text(json.dumps({**json.loads(card), "weak_points": 3}))
    refused("a card is wrong: Expected `array`", *add)
    assert not home.exists()


def test_a_model_is_replaced_only_when_that_is_said(home: Path, trained: Path) -> None:
    done("add", trained, "--name", "mine", "--user")
    add = ("add", zoo.find("svm"), "--name", "mine", "--user")
    refused("mine.onnx is there already: --force replaces it", *add)
    assert own.find("mine").read_bytes() == trained.read_bytes()
    done(*add, "--force")
    assert own.find("mine").read_bytes() == zoo.find("svm").read_bytes()
    assert own.card(own.find("mine")) == zoo.card("svm")
    assert home.exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["add"], "add needs a FILE"),
        (["remove"], "remove needs a NAME"),
        (["remove", "mine"], "no model 'mine' in "),
        (["remove", "svm"], "'svm' ships with graspd and stays"),
        (["ad", "mine.onnx"], "only add and remove take a second word: mine.onnx"),
        (["absent.onnx"], "absent.onnx: cannot read the model"),
        (["add", "absent.onnx"], "absent.onnx: cannot read the model"),
    ],
)
def test_what_cannot_be_done_is_one_line(words: list[str], says: str, home: Path) -> None:
    refused(says, *words)
    assert not home.exists()
