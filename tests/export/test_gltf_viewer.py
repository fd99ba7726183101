"""A .glb of the default head in a real viewer: three.js in Chromium, and Khronos's validator."""

import json
import os
import queue
import shutil
import subprocess
import tarfile
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import torch

from meshanim.export import write_glb
from meshanim.export.materials import gltf_materials
from meshanim.heads import HeadParameters, load_head
from meshanim.motion import MeshSequence
from meshanim.render.look import PEOPLE, make_appearance

PACKAGES = {"three": "three-0.187.0", "gltf-validator": "gltf-validator-2.0.0-dev.3.10"}
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "meshanim-tests"
FRAMES, FPS, STEP = 6, 25.0, 7


def npm_package(name):
    """Folder of an npm package in the cache, fetched once; the test is skipped where that cannot be done."""
    folder = CACHE / PACKAGES[name]
    if not folder.is_dir():
        if shutil.which("npm") is None:
            pytest.skip(f"npm is not installed, and {folder} does not exist")
        CACHE.mkdir(parents=True, exist_ok=True)
        version = PACKAGES[name].removeprefix(f"{name}-")
        try:
            subprocess.run(
                ["npm", "pack", f"{name}@{version}", "--silent"], cwd=CACHE, check=True, timeout=20,
                capture_output=True,
            )  # fmt: skip
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
            pytest.skip(f"npm cannot fetch {name}: {error}")
        unpacked = CACHE / f"{folder.name}.part-{os.getpid()}"
        with tarfile.open(CACHE / f"{folder.name}.tgz") as archive:
            archive.extractall(unpacked, filter="data")
        if not folder.is_dir():
            (unpacked / "package").rename(folder)
        shutil.rmtree(unpacked)
    return folder


@pytest.fixture(scope="module")
def talk(tmp_path_factory):
    """talk.glb of a textured person who opens the mouth, turns the head and shuts the eyes; and the truth."""
    head = load_head("default")
    appearance = make_appearance(head, PEOPLE["chidi"], 256)
    shape = torch.from_numpy(appearance.shape)[None]
    amount = np.linspace(0, 1, FRAMES)
    expression = torch.cat(
        [
            head.expression({"jawOpen": 0.7 * a, "eyeBlinkLeft": a, "eyeBlinkRight": a, "mouthPucker": a * a})
            for a in amount
        ]
    )
    pose = np.stack([0.1 * amount, 0.4 * amount, 0 * amount], axis=1).astype(np.float32)
    with torch.no_grad():
        vertices = head(HeadParameters(shape=shape, expression=expression)).numpy()
        truth = head.pose(torch.from_numpy(vertices), torch.from_numpy(pose), shape).numpy()
        pivot = head.joints(shape)[0, 1].numpy()
    sequence = MeshSequence(vertices, FPS, head.mesh, pose)
    path = tmp_path_factory.mktemp("viewer") / "talk.glb"
    materials = gltf_materials(head, appearance)
    write_glb(path, sequence, materials, pivot, head.weights[:, 1:].sum(1).numpy())
    return path, truth, materials


def in_browser(browser, folder):
    """What the page index.html of a folder posts back once it is done."""
    answers = queue.Queue()

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *words):
            pass

        def do_POST(self):
            answers.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    command = [
        browser,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        f"--user-data-dir={folder / 'profile'}",
    ]
    address = f"http://127.0.0.1:{server.server_address[1]}/index.html"
    process = subprocess.Popen(
        [*command, "--remote-debugging-port=0", address],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        return answers.get(timeout=150)
    except queue.Empty:
        pytest.fail("the page did not answer in 150 seconds")
    finally:
        process.terminate()
        process.wait(timeout=20)
        server.shutdown()
        server.server_close()


def test_plays_in_three_js_in_chromium(talk):
    """Morph targets and the head's turn put vertices where the head has them, at two times; no warnings."""
    path, truth, materials = talk
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("Chromium is not installed")
    folder = path.parent
    link = folder / "three"
    if not link.exists():
        link.symlink_to(npm_package("three"))
    chosen = [1, FRAMES - 1]
    times = [frame / FPS for frame in chosen]  # the first key is at 0
    page = (Path(__file__).parent / "viewer.html").read_text()
    (folder / "index.html").write_text(page.replace("TIMES", str(times)).replace("STEP", str(STEP)))

    report = in_browser(browser, folder)
    assert report["errors"] == [], report
    assert "failed" not in report, report
    assert len(report["frames"][0]) == len(materials)
    assert min(report["morphs"]) > 0
    assert max(report["textured"]) >= 256
    shown = [np.concatenate([np.array(mesh) for mesh in frame]) for frame in report["frames"]]
    for frame, points in zip(chosen, shown):
        distance = np.linalg.norm(points[:, None] - truth[frame][None], axis=2).min(1)
        assert distance.max() < 5e-4, f"frame {frame}: {1000 * distance.max():.2f} mm"
    assert np.linalg.norm(shown[1] - shown[0], axis=1).max() > 0.02


def test_khronos_validator_finds_no_error(talk):
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    package = npm_package("gltf-validator")
    script = """
        const validator = require(process.argv[1]);
        validator.validateBytes(new Uint8Array(require("fs").readFileSync(process.argv[2])))
          .then((report) => console.log(JSON.stringify(report.issues)));
    """
    command = ["node", "-e", script, str(package), str(talk[0])]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    issues = json.loads(done.stdout)
    assert issues["numErrors"] == 0, issues["messages"]
    assert issues["numWarnings"] == 0, issues["messages"]
