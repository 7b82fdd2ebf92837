"""The page for marking known lengths, in a browser if one is installed."""

import html
import re
import shutil
import subprocess

import numpy as np
import pytest
from support.photo_builders import exif, photo

from climatenerf.scene import Camera, Scene, View
from climatenerf.scene.alignment.known_length import read_marks
from climatenerf.sfm.mark_page import write_mark_page

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
CLICKS = """<script>
addEventListener("load", () => {
  const click = (i, x, y) => {
    const image = document.querySelectorAll("img")[i], box = image.getBoundingClientRect();
    image.dispatchEvent(new MouseEvent("click", {clientX: box.left + x * box.width,
      clientY: box.top + y * box.height}));
  };
  const end = document.getElementById("end");
  click(0, 0.25, 0.5); click(1, 0.5, 0.5);
  end.value = "to";
  click(0, 0.75, 0.5); click(1, 0.5, 0.9); click(1, 0.5, 0.25);
  document.getElementById("name").value = 'A "b"';
  click(0, 0.5, 0.5);
  const out = document.createElement("pre");
  out.id = "result"; out.textContent = document.getElementById("toml").value;
  document.body.append(out);
});
</script>"""


@pytest.fixture
def page(tmp_path):
    # One picture wider than the window, and one with an EXIF orientation.
    photo(tmp_path / "images" / "wide one.jpg", (2000, 1000))
    photo(tmp_path / "images" / "tagged.jpg", (400, 200), exif(6))
    camera = Camera(2000, 1000, 900, 900, 1000, 500), Camera(400, 200, 300, 300, 200, 100)
    views = tuple(
        View(name, tmp_path / "images" / name, i, np.eye(4))
        for i, name in enumerate(("wide one.jpg", "tagged.jpg"))
    )
    write_mark_page(tmp_path / "mark.html", Scene(tmp_path, "test", camera, views))
    return tmp_path / "mark.html"


def test_file_names_cannot_end_the_script(tmp_path):
    view = View("</script>.jpg", tmp_path / "images" / "</script>.jpg", 0, np.eye(4))
    scene = Scene(tmp_path, "test", (Camera(4, 4, 4, 4, 2, 2),), (view,))
    write_mark_page(tmp_path / "mark.html", scene)
    assert (tmp_path / "mark.html").read_text().count("</script>") == 1


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_clicks_become_marks_in_stored_pixels(page, tmp_path):
    page.write_text(page.read_text() + CLICKS)
    command = [
        BROWSER,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--allow-file-access-from-files",
    ]
    command += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=3000"]
    done = subprocess.run(
        [*command, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=120
    )
    found = re.search(r'<pre id="result">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found, done.stderr[-2000:]
    toml = html.unescape(found.group(1))
    complete = toml[: toml.index('["A ')]
    (tmp_path / "marks.toml").write_text(complete)
    marks = read_marks(tmp_path / "marks.toml")["DOOR"]
    assert marks["from"]["wide one.jpg"] == pytest.approx((500, 500), abs=3)
    assert marks["to"]["wide one.jpg"] == pytest.approx((1500, 500), abs=3)
    assert marks["from"]["tagged.jpg"] == pytest.approx((200, 100), abs=3), "pixels as stored"
    assert marks["to"]["tagged.jpg"] == pytest.approx((200, 50), abs=3), (
        "the last click replaces earlier ones"
    )
    assert '["A \\"b\\"".to]' in toml
    assert done.stdout.count("<span") == 5, "one dot per mark"
