"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const words = data.words;
const find = id => document.getElementById(id);
const canvas = find("picture");
const pen = canvas.getContext("2d", { willReadFrequently: true });

const SKY = 65535;
const OPEN = 65534; // below the horizon, without ground: any water covers it
const MAX_STEP = 0.25; // m between neighbouring pixels of one surface; more is an edge
const MIN_BAND = 0.01; // m; a smaller error is not drawn
const KINDS = ["water", "snow", "smog", "seasons"].filter(kind => data[kind === "water" ? "levels" : kind].length);

/** What is shown. */
const state = { view: 0, kind: KINDS[0], level: 0, step: 0, before: 0, mark: null };
/** What is decoded of the view that is shown: {flooding, heights, dry, water: [...], ...}. */
let shown = null;
let composed = null;

// --- numbers as text ----------------------------------------------------------------------------

function fixed(value, decimals) {
  const text = new Intl.NumberFormat(data.language, {
    minimumFractionDigits: decimals, maximumFractionDigits: decimals }).format(Math.abs(value));
  return (value < 0 && Number(value.toFixed(decimals)) !== 0 ? "\u2212" : "") + text;
}
const put = (word, text) => words[word].replace("{}", text);
const metres = value => put("metres", fixed(value, 2));
const plusMinus = value => value >= 0.005 ? ` \u00b1 ${metres(value)}` : "";

/** Standard error of a height above the datum, m. */
function heightError(height) {
  return Math.hypot(data.scale_error * height, data.level_error);
}

/** Text of a step of snow, smog or a season; step 0 is none. */
function stepText(kind, step) {
  if (step === 0) return words.none;
  const value = data[kind][step - 1];
  if (kind === "snow") {
    return put("snow_depth", put("centimetres", fixed(100 * value, value < 0.1 && (100 * value) % 1 ? 1 : 0)));
  }
  if (kind === "smog") return put("visibility", put("metres", fixed(value, value < 10 ? 1 : 0)));
  return words[value] || value;
}

// --- pictures -----------------------------------------------------------------------------------

async function pixels(text) {
  const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  const bitmap = await createImageBitmap(new Blob([bytes], { type: "image/webp" }),
    { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  const sheet = new OffscreenCanvas(bitmap.width, bitmap.height);
  const context = sheet.getContext("2d", { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  return context.getImageData(0, 0, sheet.width, sheet.height).data;
}

async function colours(text) {
  return new Uint32Array((await pixels(text)).buffer);
}

/**
 * Two maps in metres: the level from which each pixel is under water, and the height of what it
 * shows. Infinity for the sky, -Infinity where no ground is seen.
 */
async function mapsOf(view) {
  const coded = await pixels(view.heights);
  const flooding = new Float32Array(coded.length / 4);
  const heights = new Float32Array(coded.length / 4);
  for (let i = 0; i < heights.length; i++) {
    const count = coded[4 * i] * 256 + coded[4 * i + 1];
    flooding[i] = count === SKY ? Infinity : count === OPEN ? -Infinity : view.low + count * data.step;
    heights[i] = flooding[i] - (coded[4 * i + 2] - 128) * data.difference_step;
  }
  return { flooding, heights };
}

/** Decode what a view needs, and return it; pictures of other kinds follow when they are chosen. */
async function load(index, kind) {
  const view = data.views[index];
  let held = shown && shown.index === index ? shown : null;
  if (!held) {
    const [maps, dry] = await Promise.all([mapsOf(view), colours(view.dry)]);
    held = { index, ...maps, dry };
  }
  if (!held[kind]) held[kind] = await Promise.all(view[kind].map(colours));
  return held;
}

/** Blend two packed pixels; weight of the second in 256ths. */
function blend(a, b, weight) {
  const rest = 256 - weight;
  const redBlue = (((a & 0xff00ff) * rest + (b & 0xff00ff) * weight) / 256) & 0xff00ff;
  const green = (((a >>> 8) & 0xff) * rest + ((b >>> 8) & 0xff) * weight) & 0xff00;
  return (0xff000000 | redBlue | green) >>> 0;
}

/**
 * Colours under water of a level: a pixel is wet if the level from which it is under water
 * lies below. Its colour is blended from the rendered levels around, if it is wet in both; else it is the upper one's.
 * Returns the number of wet pixels.
 */
function compose(flooding, dry, pictures, levels, level, out) {
  let upper = levels.findIndex(each => each >= level - 1e-6);
  if (upper < 0) upper = levels.length - 1;
  const lower = upper - 1;
  const low = lower >= 0 ? levels[lower] : -Infinity;
  const weight = lower >= 0 ? Math.round(256 * Math.min(1, (level - low) / (levels[upper] - low))) : 256;
  const above = pictures[upper];
  const below = lower >= 0 ? pictures[lower] : above;
  let wet = 0;
  for (let i = 0; i < flooding.length; i++) {
    const from = flooding[i];
    if (from < level) {
      wet++;
      out[i] = from < low ? blend(below[i], above[i], weight) : above[i];
    } else {
      out[i] = dry[i];
    }
  }
  return wet;
}

/** Draw a dashed line where water of a level would end. */
function outline(flooding, width, level, out, colour) {
  for (let i = 0; i < flooding.length - width - 1; i++) {
    const here = flooding[i];
    for (const j of [i + 1, i + width]) {
      const there = flooding[j];
      if ((here < level) !== (there < level) && Math.abs(here - there) < MAX_STEP
          && (((i % width) + Math.floor(i / width)) & 7) < 5) {
        out[i] = colour;
        out[j] = colour;
      }
    }
  }
}

// --- drawing ------------------------------------------------------------------------------------

/** Show the state; returns how long it took, ms. */
function draw() {
  if (!shown || !shown[state.kind]) return 0;
  const begun = performance.now();
  const [width, height] = data.views[state.view].size;
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
    canvas.style.width = `min(100%, ${72 * width / height}vh)`;
    composed = null;
  }
  composed = composed || pen.createImageData(width, height);
  const out = new Uint32Array(composed.data.buffer);
  let wet = 0;
  if (state.kind === "water") {
    wet = compose(shown.flooding, shown.dry, shown.water, data.levels, state.level, out);
    const error = heightError(state.level);
    if (error >= MIN_BAND) {
      outline(shown.flooding, width, state.level + error, out, 0xffffffff);
      outline(shown.flooding, width, state.level - error, out, 0xff00ffff);
    }
  } else {
    out.set(state.step === 0 ? shown.dry : shown[state.kind][state.step - 1]);
  }
  const split = Math.round(state.before / 100 * width);
  if (split > 0) {
    for (let row = 0; row < height; row++) {
      out.set(shown.dry.subarray(row * width, row * width + split), row * width);
    }
  }
  pen.putImageData(composed, 0, 0);
  captions(width, height, split);
  describe(wet / out.length);
  return performance.now() - begun;
}

function caption() {
  if (state.kind !== "water") return stepText(state.kind, state.step);
  const datum = data.datum ? `${words.above_datum} ${data.datum}` : words.above;
  return `${words.level} ${metres(state.level)}${plusMinus(heightError(state.level))} ${datum}`;
}

/** Draw the texts into the picture, so that they travel with every copy of it. */
function captions(width, height, split) {
  const scale = width / (canvas.clientWidth || width);
  const size = Math.max(13 * scale, width / 60);
  const lines = [data.title, caption(), state.kind === "water" && data.scenario].filter(Boolean);
  const foot = [words.simulation.toUpperCase(), words.made_with, data.source].filter(Boolean).join(" \u00b7 ");
  strip(lines, size, 0, width, height);
  strip([foot], size * 0.85, 1, width, height);
  if (split > 0) {
    pen.fillStyle = "#fff";
    pen.fillRect(split - scale, 0, 2 * scale, height);
    label(words.before, size, Math.max(split - 6 * scale, 0), "right", height);
    if (split < width) label(words.after, size, split + 6 * scale, "left", height);
  }
  if (state.mark) cross(state.mark, scale, size);
}

/** Split a text into lines no wider than the picture. */
function wrapped(text, wide) {
  const lines = [];
  for (const word of text.split(" ")) {
    const longer = lines.length ? `${lines[lines.length - 1]} ${word}` : word;
    if (lines.length && pen.measureText(longer).width <= wide) lines[lines.length - 1] = longer;
    else lines.push(word);
  }
  return lines;
}

function strip(texts, size, bottom, width, height) {
  pen.font = `${Math.round(size)}px system-ui, sans-serif`;
  pen.textBaseline = "top";
  pen.textAlign = "left";
  const lines = texts.flatMap(text => wrapped(text, width - size));
  const tall = size * 1.3;
  const top = bottom ? height - tall * lines.length - size * 0.4 : 0;
  const wide = Math.max(...lines.map(line => pen.measureText(line).width)) + size;
  pen.fillStyle = "rgba(0, 0, 0, .62)";
  pen.fillRect(0, top, wide, tall * lines.length + size * 0.4);
  pen.fillStyle = "#fff";
  lines.forEach((line, i) => pen.fillText(line, size * 0.5, top + size * 0.3 + i * tall));
}

function label(text, size, x, align, height) {
  pen.font = `${Math.round(size)}px system-ui, sans-serif`;
  pen.textBaseline = "middle";
  pen.textAlign = align;
  pen.lineWidth = size / 4;
  pen.strokeStyle = "#000";
  pen.strokeText(text, x, height / 2);
  pen.fillStyle = "#fff";
  pen.fillText(text, x, height / 2);
}

function cross([x, y], scale, size) {
  for (const [colour, width] of [["#000", 4], ["#fff", 2]]) {
    pen.strokeStyle = colour;
    pen.lineWidth = width * scale;
    pen.beginPath();
    pen.moveTo(x - 9 * scale, y);
    pen.lineTo(x + 9 * scale, y);
    pen.moveTo(x, y - 9 * scale);
    pen.lineTo(x, y + 9 * scale);
    pen.stroke();
  }
  const text = measured();
  pen.font = `${Math.round(size)}px system-ui, sans-serif`;
  const wide = pen.measureText(text).width + size;
  const left = Math.min(Math.max(x + 12 * scale, 0), Math.max(canvas.width - wide, 0));
  const middle = Math.min(Math.max(y, size), canvas.height - size);
  pen.fillStyle = "rgba(0, 0, 0, .72)";
  pen.fillRect(left, middle - size * 0.8, wide, size * 1.6);
  pen.textAlign = "left";
  pen.textBaseline = "middle";
  pen.fillStyle = "#fff";
  pen.fillText(text, left + size / 2, middle);
}

// --- measuring ----------------------------------------------------------------------------------

/** Height of what the marked pixel shows, m above the datum; null without a mark. */
function markedHeight() {
  if (!state.mark || !shown) return null;
  return shown.heights[state.mark[1] * canvas.width + state.mark[0]];
}

/** Depth of the water at the mark, m; 0 where it is drawn dry. */
function markedDepth() {
  const height = markedHeight();
  if (height === null || shown.flooding[state.mark[1] * canvas.width + state.mark[0]] >= state.level) return 0;
  return Math.max(data.step, state.level - height);
}

function measured() {
  const height = markedHeight();
  if (height === null) return "";
  if (height === Infinity) return words.sky;
  if (height === -Infinity) return words.unseen;
  const ground = put("ground", metres(height) + plusMinus(heightError(height)));
  if (state.kind !== "water") return ground;
  const depth = markedDepth();
  if (depth === 0) return `${words.dry_here}, ${ground}`;
  const error = Math.hypot(data.scale_error * depth, data.level_error);
  return `${put("water_here", metres(depth) + plusMinus(error))}, ${ground}`;
}

/** Put the mark at a pixel. */
function mark(x, y) {
  state.mark = [Math.min(Math.max(Math.floor(x), 0), canvas.width - 1),
    Math.min(Math.max(Math.floor(y), 0), canvas.height - 1)];
  draw();
  find("told").textContent = measured();
}

function describe(wet) {
  const parts = [`${words.picture}: ${data.title}`, data.views[state.view].name, caption()];
  if (state.kind === "water") parts.push(put("under_water", fixed(100 * wet, 0)));
  canvas.setAttribute("aria-label", parts.join(", "));
  if (state.kind === "water") {
    const text = `${metres(state.level)}${plusMinus(heightError(state.level))}`;
    find("level-shown").textContent = text;
    find("level").setAttribute("aria-valuetext", text);
  }
}

// --- controls -----------------------------------------------------------------------------------

function radios(set, name, texts, chosen, choose) {
  set.querySelectorAll("label").forEach(each => each.remove());
  texts.forEach((text, i) => {
    const row = document.createElement("label");
    const button = document.createElement("input");
    button.type = "radio";
    button.name = name;
    button.value = i;
    button.checked = i === chosen;
    button.addEventListener("change", () => choose(i));
    row.append(button, text);
    set.append(row);
  });
}

async function choose(view, kind, step = 0) {
  if (view !== state.view) state.mark = null;
  const wanted = [view, kind].join();
  choose.wanted = wanted;
  let held;
  try {
    held = await load(view, kind);
  } catch (error) {
    find("told").textContent = words.broken;
    throw error;
  }
  if (choose.wanted !== wanted) return; // another was chosen meanwhile
  shown = held;
  Object.assign(state, { view, kind, step });
  find("told").textContent = "";
  find("water").hidden = kind !== "water";
  find("steps").hidden = kind === "water";
  for (const button of find("kinds").children) {
    const selected = button.dataset.kind === kind;
    button.setAttribute("aria-selected", selected);
    button.tabIndex = selected ? 0 : -1;
  }
  if (kind !== "water") {
    find("steps-label").textContent = words[kind];
    const texts = [0, ...data[kind].keys()].map((_, i) => stepText(kind, i));
    radios(find("steps"), "step", texts, step, chosen => {
      state.step = chosen;
      draw();
      remember();
    });
  }
  draw();
  remember();
}

/** Keep what is shown in the address, so that it can be sent to somebody. */
function remember() {
  const parts = [`view=${state.view + 1}`, `show=${state.kind}`];
  parts.push(state.kind === "water" ? `level=${state.level.toFixed(2)}` : `step=${state.step}`);
  try {
    history.replaceState(null, "", `#${parts.join("&")}`);
  } catch (error) { /* a browser may forbid it for files */ }
}

function fromAddress() {
  const found = new URLSearchParams(location.hash.slice(1));
  const number = (name, otherwise, low, high) => {
    const value = Number(found.get(name) ?? NaN);
    return Number.isFinite(value) ? Math.min(Math.max(value, low), high) : otherwise;
  };
  const kind = KINDS.includes(found.get("show")) ? found.get("show") : KINDS[0];
  const last = data.levels[data.levels.length - 1];
  const middle = data.levels[Math.floor(data.levels.length / 2)];
  state.level = number("level", middle, Number(find("level").min), last);
  const step = Math.round(number("step", kind === "water" ? 0 : 1, 0, (data[kind] || []).length));
  return [Math.round(number("view", 1, 1, data.views.length)) - 1, kind, step];
}

function start() {
  find("page").hidden = false;
  find("kinds").setAttribute("aria-label", words.kinds);
  for (const kind of KINDS) {
    const button = document.createElement("button");
    button.type = "button";
    button.role = "tab";
    button.dataset.kind = kind;
    button.setAttribute("aria-controls", "controls");
    button.textContent = words[kind];
    button.addEventListener("click", () => choose(state.view, kind, kind === "water" ? 0 : 1));
    find("kinds").append(button);
  }
  find("kinds").addEventListener("keydown", event => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const next = (KINDS.indexOf(state.kind) + step + KINDS.length) % KINDS.length;
    find("kinds").children[next].focus();
    find("kinds").children[next].click();
  });
  find("kinds").hidden = KINDS.length < 2;

  const slider = find("level");
  const low = data.levels[0], high = data.levels[data.levels.length - 1];
  slider.min = data.lowest;
  slider.max = high;
  find("level-label").textContent = words.level;
  slider.addEventListener("input", () => {
    state.level = Number(slider.value);
    draw();
    find("told").textContent = measured();
  });
  slider.addEventListener("change", remember);
  const span = high - Number(slider.min);
  const at = level => 100 * (level - Number(slider.min)) / span;
  const ticks = [Number(slider.min), high];
  for (const level of data.levels) { // none that would run into another's text
    if (ticks.every(other => Math.abs(at(other) - at(level)) > 17)) ticks.push(level);
  }
  for (const level of ticks.sort((a, b) => a - b)) {
    const tick = document.createElement("span");
    tick.textContent = metres(level);
    tick.style.left = `${at(level)}%`;
    find("ticks").append(tick);
  }

  find("compare-label").textContent = words.compare;
  find("compare").addEventListener("input", () => {
    state.before = Number(find("compare").value);
    draw();
  });
  find("views-label").textContent = words.views;
  find("views").hidden = data.views.length < 2;
  canvas.addEventListener("click", event => {
    const box = canvas.getBoundingClientRect();
    mark((event.clientX - box.left) / box.width * canvas.width,
      (event.clientY - box.top) / box.height * canvas.height);
  });
  canvas.addEventListener("keydown", event => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (event.key === "Escape") {
      state.mark = null;
      draw();
    }
    if (!step) return;
    event.preventDefault();
    const size = event.shiftKey ? 1 : 12;
    const [x, y] = state.mark || [canvas.width / 2, canvas.height / 2];
    mark(x + step[0] * size, y + step[1] * size);
  });
  find("hint").textContent = words.hint + (heightError(high) >= MIN_BAND ? ` ${words.band}` : "");
  find("notes").textContent = [words.simulation, words.made_with, data.scenario, data.source]
    .filter(Boolean).join(" \u00b7 ");
  find("told").textContent = words.loading;
  const [view, kind, step] = fromAddress();
  slider.value = state.level;
  radios(find("views"), "view", data.views.map((_, i) => `${words.view} ${i + 1}`), view,
    chosen => choose(chosen, state.kind, state.step));
  addEventListener("resize", () => draw());
  addEventListener("hashchange", () => {
    const [other, what, which] = fromAddress();
    slider.value = state.level;
    find("views").querySelectorAll("input").forEach((each, i) => { each.checked = i === other; });
    choose(other, what, which);
  });
  return choose(view, kind, step);
}

start();
