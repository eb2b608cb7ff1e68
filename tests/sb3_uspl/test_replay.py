"""The replay page holds the whole episode, needs no network and shows what it holds."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

pytest.importorskip("matplotlib")
pytest.importorskip("plotly")

from plotly.offline import get_plotlyjs

import bullet_tasks  # noqa: F401
from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box, Cylinder
from sb3_uspl import USPLPPO
from sb3_uspl.envs import TargetReachingEnv
from sb3_uspl.film import record_clip
from sb3_uspl.replay import page_data, scene_mesh, write_replay
from tests.sb3_uspl.toy import ToyEnv

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# Software rendering, no network, and virtual time: 2.5 s of the page's, however long they take here.
BROWSER_OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--window-size=1100,700"),
    *("--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--virtual-time-budget=2500",
)
VIEW_HEIGHT = 540  # pixels
ARTEFACTS = Path(__file__).resolve().parents[2] / "build" / "test_artefacts"

STUBS = """
const elements = {}, calls = [];
const element = id => elements[id] ??= { on() {}, textContent: "", value: "0" };
globalThis.location = { hash: "" };
globalThis.document = { getElementById: element };
element("data").textContent = require("fs").readFileSync(0, "utf8");
element("speed").value = "1000";
const note = (...call) => calls.push(call);
globalThis.Plotly = { restyle: note, relayout: note, newPlot: async () => {} };
"""


def tiny(env):
    return USPLPPO("MlpPolicy", env, n_steps=64, batch_size=64, mismatch_fraction=0.0, seed=0, device="cpu")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    env = gym.make("LateralChoice-v0")
    out = tmp_path_factory.mktemp("replay") / "sub" / "page.html"
    clip = write_replay(tiny(env), env, 3, out, "a </script> & b")
    env.close()
    return out, clip


def data_of(out):
    text = out.read_text("utf-8")
    return json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.S)[1])


def test_page_has_every_moment_of_the_episode(page):
    out, clip = page
    data, n = data_of(out), len(clip.poses)
    assert n > 5 and data["period"] == 0.25
    assert {len(data[key]) for key in ("poses", "centres", "half_widths", "sigmas", "errors")} == {n}
    np.testing.assert_allclose(np.array(data["poses"])[:, [0, 1, 3]], clip.poses, atol=1e-6)
    np.testing.assert_allclose(data["sigmas"], clip.sigmas)
    assert data["outcome"].startswith("reached" if clip.success else "failed")
    assert data["curves"]["data"][0]["y"] == data["sigmas"] and data["curves"]["data"][0]["x"][-1] == 0.25 * (n - 1)
    for name, kind in (("path", "scatter3d"), ("belief", "mesh3d"), ("robot", "mesh3d")):
        assert data["scene"]["data"][data["traces"][name]]["type"] == kind


def test_page_references_no_network_address(page):
    text = page[0].read_text("utf-8").replace(get_plotlyjs(), "")
    assert len(text) < 1e6 and "://" not in text and not re.search(r"""(src|href)\s*=\s*["'](?!data:)""", text)
    assert "default-src 'none'" in text and "connect-src" not in text
    assert "a &lt;/script> &amp; b" in text


def test_the_same_episode_as_in_a_film(page):
    env = gym.make("LateralChoice-v0")
    clip = record_clip(tiny(env), env, 3)
    env.close()
    assert clip.poses == page[1].poses


def test_meshes_are_closed_and_have_the_shapes_sizes():
    scene = SceneSpec(
        (
            Box("box", (1.0, 2.0, 3.0), (0.5, 0.25, 1.0), yaw=np.pi / 2),
            Cylinder("cylinder", (-3.0, 0.0, 0.0), 0.5, 2.0),
            Box("parked", (0.0, 0.0, -100.0), (1.0, 1.0, 1.0)),
        )
    )
    points, triangles, colours = scene_mesh(scene)
    assert len(triangles) == len(colours) == 12 + 4 * 32 - 4 and triangles.max() == len(points) - 1
    box, cylinder = points[:8], points[8:]
    np.testing.assert_allclose([box.min(axis=0), box.max(axis=0)], [(0.75, 1.5, 2.0), (1.25, 2.5, 4.0)], atol=1e-12)
    np.testing.assert_allclose(
        [cylinder.min(axis=0), cylinder.max(axis=0)], [(-3.5, -0.5, -2.0), (-2.5, 0.5, 2.0)], atol=1e-12
    )
    # Closed and outward: every edge is met once in each direction, and the enclosed volume is positive and right.
    edges = [tuple(edge) for t in triangles for edge in (t[[0, 1]], t[[1, 2]], t[[2, 0]])]
    assert len(set(edges)) == len(edges) and {(b, a) for a, b in edges} == set(edges)
    volume = np.linalg.det(points[triangles]).sum() / 6.0
    assert volume == pytest.approx(1.0 + 0.5 * 32 * np.sin(2 * np.pi / 32) * 0.25 * 4.0)


def test_an_environment_without_a_scene_and_one_with_a_camera(tmp_path):
    env = gym.wrappers.TimeLimit(TargetReachingEnv(), 5)
    clip = write_replay(tiny(env), env, 0, tmp_path / "a.html")
    assert data_of(tmp_path / "a.html")["camera"] == [] and len(clip.poses) == 6
    clip.views = [np.full((10, 16), 40 * i, np.uint8) for i in range(6)]
    data = page_data(clip, [0.0] * 6, 0.2)
    assert len(set(data["camera"])) == 6 and all(view.startswith("data:image/png;base64,") for view in data["camera"])


class Placed(gym.Wrapper):
    """Says where a belief lies, as a wrapper of one's own does, for an environment without a decision period."""

    where, axes = True, 2

    def reset(self, **kwargs):
        obs, info = self.env.reset(**kwargs)
        return obs, info | ({"position": (0.0, 0.0)} if self.where else {})

    def step(self, action):
        *result, info = self.env.step(action)
        return *result, info | ({"position": (1.0, 0.0)} if self.where else {})

    def belief_in_world(self, mean, std):
        return np.resize(mean, self.axes), np.resize(std, self.axes)


def test_a_wrappers_map_is_taken_and_what_it_needs_is_named(tmp_path, monkeypatch):
    monkeypatch.delattr(ToyEnv, "decision_period")
    env = Placed(ToyEnv())
    model = tiny(env)
    clip = write_replay(model, env, 1, tmp_path / "page.html")
    assert clip.goal.tolist() == [clip.truth[0]] * 2 and len(clip.poses) > 2
    for name, value, message in (("axes", 1, "at least two numbers"), ("where", False, "position")):
        monkeypatch.setattr(Placed, name, value)
        with pytest.raises(ValueError, match=message):
            write_replay(model, env, 1, tmp_path / "page.html")
        monkeypatch.undo()


def test_what_cannot_be_replayed_is_refused(tmp_path, monkeypatch):
    env = ToyEnv()
    model = tiny(env)
    with pytest.raises(ValueError, match=r"a replay is a \.html file"):
        write_replay(model, env, 0, tmp_path / "a.gif")
    with pytest.raises(ValueError, match="belief_in_world"):
        write_replay(model, env, 0, tmp_path / "a.html")
    monkeypatch.setitem(__import__("sys").modules, "plotly.offline", None)
    with pytest.raises(ValueError, match=r"pip install -e \"\.\[replay\]\""):
        write_replay(model, env, 0, tmp_path / "a.html")


@pytest.mark.skipif(shutil.which("node") is None, reason="no node to run the page's script")
def test_script_plays_to_the_end_and_the_timeline_leads_back(page):
    out, clip = page
    script = re.search(r"<script>\n(const data = .*?)</script>", out.read_text("utf-8"), re.S)[1]
    check = """
    setTimeout(() => {
      element("play").onclick();
      setTimeout(() => {
        const end = element("outcome").textContent;
        element("timeline").value = "2";
        element("timeline").oninput();
        const path = calls.filter(call => call[2] == data.traces.path).at(-1)[1];
        console.log(JSON.stringify([end, element("timeline").max, path.x[0].length, element("outcome").textContent]));
      }, 3000);
    }, 50);
    """
    program = STUBS + script + check
    result = subprocess.run(
        ["node", "-e", program], input=json.dumps(data_of(out)), capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout) == [data_of(out)["outcome"], len(clip.poses) - 1, 3, "running"]


def browse(address, folder):
    """Open a page, wait until it has drawn itself, and take a picture; return what it holds by then."""
    where = (f"--user-data-dir={folder / 'profile'}", f"--screenshot={folder / 'page.png'}", "--dump-dom", address)
    result = subprocess.run([BROWSER, *BROWSER_OPTIONS, *where], capture_output=True, text=True, timeout=600)
    assert "Refused to" not in result.stderr
    with Image.open(folder / "page.png") as image:
        return result.stdout, image.convert("RGB").crop((0, 0, image.width, VIEW_HEIGHT))


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium here: apt-get install chromium")
def test_page_draws_itself_in_a_browser(page, tmp_path):
    """The picture is kept in build/."""
    # A picture is higher than the view that the page is laid out for.
    lower = tmp_path / "page.html"
    lower.write_text(page[0].read_text("utf-8").replace("height: 100vh", f"height: {VIEW_HEIGHT}px"), "utf-8")
    begin, picture = browse(lower.as_uri(), tmp_path)
    assert begin.count("gl-container") >= 1, "no 3-D scene"
    assert re.search(r'<output id="time">0\.00 s', begin) and '<span id="outcome">running' in begin
    assert len(picture.getcolors(picture.width * picture.height)) > 100, "nothing was drawn"
    ARTEFACTS.mkdir(parents=True, exist_ok=True)
    picture.save(ARTEFACTS / "replay.png")
