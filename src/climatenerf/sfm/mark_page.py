"""An HTML page on which the user marks the ends of known lengths in a scene's pictures."""

import json
from pathlib import Path
from urllib.parse import quote

from climatenerf.core.storage import write_bytes
from climatenerf.scene.scene import Scene

_PAGE = """<!doctype html>
<meta charset="utf-8">
<title>Mark known lengths</title>
<style>
body { font: 15px sans-serif; margin: 1em; }
textarea { width: 100%; height: 14em; font: 13px monospace; }
figure { position: relative; width: fit-content; margin: .3em 0 1em; }
/* Poses refer to pixels as stored, so EXIF must not rotate the pictures. */
img { max-width: 100%; cursor: crosshair; display: block; image-orientation: none; }
figure span { position: absolute; color: #fff; background: #c22; font-size: 11px; padding: 0 3px;
  transform: translate(6px, -6px); pointer-events: none; }
figure span::before { content: ""; position: absolute; left: -9px; top: 3px; width: 6px;
  height: 6px; border-radius: 3px; background: #c22; }
</style>
<h1>Mark known lengths</h1>
<p>Choose a name and an end. Then click on that end in two or more pictures from camera positions
well apart. A new click on a picture moves the mark. Save the text as <code>marks.toml</code> beside
this page and add <code>--known-length "NAME=2.0 m"</code> to the command.</p>
<p>Name <input id="name" value="DOOR"> end
<select id="end"><option>from</option><option>to</option></select>
<button onclick="marks = {}; show()">clear all</button></p>
<textarea id="toml" readonly></textarea>
<div id="pictures"></div>
<script>
const pictures = PICTURES;
let marks = {}, images = {};
function show() {
  let text = "";
  for (const [name, ends] of Object.entries(marks))
    for (const [end, pixels] of Object.entries(ends)) {
      text += "[" + JSON.stringify(name) + "." + end + "]\\n";
      for (const [picture, [x, y]] of Object.entries(pixels))
        text += JSON.stringify(picture) + " = [" + x + ", " + y + "]\\n";
    }
  document.getElementById("toml").value = text;
  for (const dot of document.querySelectorAll("figure span")) dot.remove();
  for (const [name, ends] of Object.entries(marks))
    for (const [end, pixels] of Object.entries(ends))
      for (const [picture, [x, y]] of Object.entries(pixels)) {
        const image = images[picture], dot = document.createElement("span");
        dot.textContent = name + " " + end;
        dot.style.left = 100 * x / image.marked.width + "%";
        dot.style.top = 100 * y / image.marked.height + "%";
        image.parentNode.append(dot);
      }
}
for (const picture of pictures) {
  const title = document.createElement("div"), image = document.createElement("img");
  const figure = document.createElement("figure");
  images[picture.name] = image;
  image.marked = picture;  // naturalWidth is the width after rotation by EXIF
  title.textContent = picture.name;
  image.src = picture.file;
  image.loading = "lazy";
  image.onclick = event => {
    const scale = picture.width / image.clientWidth;
    const name = document.getElementById("name").value;
    const end = document.getElementById("end").value;
    marks[name] ??= {};
    marks[name][end] ??= {};
    marks[name][end][picture.name] =
      [event.offsetX, event.offsetY].map(v => Math.round(v * scale * 10) / 10);
    show();
  };
  figure.append(image);
  document.getElementById("pictures").append(title, figure);
}
</script>
"""


def write_mark_page(path: Path, scene: Scene) -> None:
    """Write the page. Pictures are linked relative to it.

    Args:
        path: file to write.
        scene: scene with the pictures.
    """
    root = path.parent.absolute()
    pictures = [
        {
            "name": view.name,
            "file": quote(view.path.relative_to(root).as_posix())
            if view.path.is_relative_to(root)
            else view.path.as_uri(),
            "width": scene.cameras[view.camera].width,
            "height": scene.cameras[view.camera].height,
        }
        for view in scene.views
    ]
    # Escape "<": a file name with "</script>" must not end the script.
    listed = json.dumps(pictures).replace("<", "\\u003c")
    write_bytes(path, _PAGE.replace("PICTURES", listed, 1).encode())
