"use strict";

// The plan: which pairs a participant sees, in which order, on which sides. Pure functions of the
// study and the participant's number, so a reload finds the same plan.

/** A 32-bit hash: FNV-1a over UTF-16 code units, then the finaliser of MurmurHash3. */
function hash(text) {
  let value = 0x811c9dc5;
  for (let i = 0; i < text.length; i++) {
    value = Math.imul(value ^ text.charCodeAt(i), 0x01000193);
  }
  value = Math.imul(value ^ (value >>> 16), 0x85ebca6b);
  value = Math.imul(value ^ (value >>> 13), 0xc2b2ae35);
  return (value ^ (value >>> 16)) >>> 0;
}

/** The items in an order that depends on their ids and on a text alone. */
function ranked(items, text) {
  const keyed = items.map(item => [hash(`${text}/${item.id}`), item]);
  keyed.sort(([a, x], [b, y]) => a - b || (x.id < y.id ? -1 : 1));
  return keyed.map(([, item]) => item);
}

/**
 * The trials of a participant: {pair, swapped, repeat, catch}.
 *
 * Participants 2k-1 and 2k see the same pairs with exchanged sides. So each pair is balanced over
 * participants, and for one participant every group of pairs is balanced, all to within one.
 */
function plan(study, participant) {
  const couple = `${study.id}/${Math.ceil(participant / 2)}`;
  const mirrored = participant % 2;
  const person = `${study.id}/${participant}`;

  // One pair of each group in turn, until there are enough.
  const names = [...new Set(study.pairs.map(pair => pair.group))];
  const groups = ranked(names.map(id => ({ id })), couple)
    .map(({ id }) => ranked(study.pairs.filter(pair => pair.group === id), couple));
  const chosen = groups.map(() => []);
  const wanted = Math.min(study.votes, study.pairs.length);
  for (let count = 0, turn = 0; count < wanted; turn++) {
    for (let g = 0; g < groups.length && count < wanted; g++) {
      if (turn < groups[g].length) {
        chosen[g].push(groups[g][turn]);
        count++;
      }
    }
  }
  const sided = chosen.flat().map((pair, i) =>
    ({ pair, swapped: (i + mirrored) % 2 === 1, repeat: false, catch: false }));

  const main = ranked(sided.map(trial => ({ id: trial.pair.id, trial })), `${person}/order`)
    .map(({ trial }) => trial);
  const fraction = text => hash(`${person}/${text}`) / 2 ** 32;
  const placed = main.map((trial, i) => [i, trial]);
  const early = main.slice(0, Math.floor(main.length / 2));
  const repeated = ranked(early.map(trial => ({ id: trial.pair.id, trial })), `${person}/repeat`);
  for (const { id, trial } of repeated.slice(0, study.repeats)) {
    const place = main.length * (0.75 + 0.25 * fraction(`repeat/${id}`)) - 0.25;
    placed.push([place, { ...trial, swapped: !trial.swapped, repeat: true }]);
  }
  study.catches.forEach((pair, i) => {
    const place = main.length * (i + fraction(`catch/${i}`)) / study.catches.length;
    const swapped = (hash(`${couple}/catch/${i}`) + mirrored) % 2 === 1;
    placed.push([Math.max(place, 0.5), { pair, swapped, repeat: false, catch: true }]);
  });
  return placed.sort(([a], [b]) => a - b).map(([, trial]) => trial);
}

/** Ids of the left and the right picture of a trial. */
function sidesOf({ pair, swapped }) {
  return swapped ? [pair.media[1], pair.media[0]] : pair.media;
}

const COLUMNS = ["study", "participant", "order", "pair", "kind", "effect", "scene", "left", "right",
  "choice", "ms", "repeat", "catch"];

/** The votes of a participant as CSV (RFC 4180). */
function csvOf(study, participant, votes) {
  const trials = plan(study, participant);
  const rows = votes.map(({ choice, ms }, i) => {
    const trial = trials[i], { pair } = trial;
    return [study.id, participant, i + 1, pair.id, pair.kind, pair.effect, pair.scene,
      ...sidesOf(trial), choice, ms, +trial.repeat, +trial.catch];
  });
  const quoted = cell => /[",\r\n]/.test(cell) ? `"${String(cell).replaceAll('"', '""')}"` : cell;
  return [COLUMNS, ...rows].map(row => row.map(quoted).join(",") + "\r\n").join("");
}

// The page.

const NOT_BEFORE = 200;  // ms after which a pair can be judged: not by the second tap of a double one
const study = JSON.parse(document.getElementById("data").textContent);
const element = id => document.getElementById(id);
const urls = new Map();
let participant = null, trials = [], votes = [];
let shown = 0;  // counts what was shown, so that a late picture of an earlier pair is dropped
let ready = false, readyAt = 0;

/** What was stored under a name; undefined without storage. */
function stored(name) {
  try {
    return localStorage.getItem(`${study.id}/${name}`);
  } catch {
    return undefined;
  }
}

function store(name, value) {
  try {
    localStorage.setItem(`${study.id}/${name}`, value);
  } catch {
    element("no-storage").hidden = false;
  }
}

function votesOf(number) {
  try {
    const found = JSON.parse(stored(`votes/${number}`) ?? "null");
    const sound = Array.isArray(found) && found.every(({ choice, ms }) =>
      ["left", "right", "skipped"].includes(choice) && Number.isInteger(ms));
    return sound ? found.slice(0, plan(study, number).length) : null;
  } catch {
    return null;
  }
}

function show(id) {
  for (const each of ["welcome", "trial", "end"]) element(each).hidden = each !== id;
  window.scrollTo(0, 0);
}

function urlOf(id) {
  const { type, file, data } = study.media[id];
  if (file !== null) return file;
  if (!urls.has(id)) {
    const bytes = Uint8Array.from(atob(data), letter => letter.charCodeAt(0));
    urls.set(id, URL.createObjectURL(new Blob([bytes], { type })));
  }
  return urls.get(id);
}

/** A picture or movie once it can be shown; rejects if it cannot. */
function loaded(id, label) {
  const movie = study.media[id].type.startsWith("video/");
  const node = document.createElement(movie ? "video" : "img");
  if (movie) {
    node.muted = node.playsInline = true;
    node.preload = "auto";
    node.setAttribute("aria-label", label);
  } else {
    node.alt = label;
    node.draggable = false;
  }
  return new Promise((resolve, reject) => {
    // Phones load no more than the head of a movie before it plays.
    node.addEventListener(movie ? "loadedmetadata" : "load", () => resolve(node), { once: true });
    node.addEventListener("error", () => reject(new Error(id)), { once: true });
    node.src = urlOf(id);
    if (movie) node.load();
  });
}

function setReady(value, hint) {
  ready = value;
  if (value) readyAt = performance.now();
  for (const side of ["left", "right"]) {
    element(`choose-${side}`).setAttribute("aria-disabled", String(!value));
  }
  element("hint").textContent = hint;
}

async function showTrial() {
  if (votes.length >= trials.length) return showEnd();
  show("trial");
  const number = ++shown, trial = trials[votes.length];
  // Without the effect, a picture that shows none would look the most realistic.
  const { effect } = trial.pair;
  element("question").textContent =
    `${effect[0].toUpperCase()}${effect.slice(1)}: which one looks more realistic?`;
  element("position").textContent = `${votes.length + 1} of ${trials.length}`;
  const bar = document.querySelector(".bar");
  bar.setAttribute("aria-valuemax", trials.length);
  bar.setAttribute("aria-valuenow", votes.length);
  bar.firstElementChild.style.width = `${100 * votes.length / trials.length}%`;
  element("skip").hidden = true;
  setReady(false, "");
  const late = setTimeout(() => setReady(false, "Loading …"), 400);
  try {
    const [left, right] = sidesOf(trial);
    const nodes = await Promise.all([loaded(left, "first"), loaded(right, "second")]);
    if (number !== shown) return;
    element("left").replaceChildren(nodes[0]);
    element("right").replaceChildren(nodes[1]);
    if (trial.pair.kind === "movie" && !trial.catch) playBoth(nodes, number);
    else setReady(true, "");
  } catch {
    if (number !== shown) return;
    setReady(false, "This browser cannot show this pair.");
    element("left").replaceChildren();
    element("right").replaceChildren();
    element("skip").hidden = false;
  } finally {
    clearTimeout(late);
  }
}

/** Play two movies together in a loop; a vote is taken once both have played to their end. */
function playBoth(movies, number) {
  const ended = new Set();
  let complete = false;
  const begin = () => {
    ended.clear();
    for (const movie of movies) {
      movie.currentTime = 0;
      movie.play().catch(() => {
        if (number === shown && !complete) setReady(false, "Tap a movie to play both.");
      });
    }
  };
  for (const movie of movies) {
    movie.addEventListener("click", begin);
    movie.addEventListener("playing", () => {
      if (number === shown && !complete) setReady(false, "Watch both to the end.");
    });
    movie.addEventListener("ended", () => {
      ended.add(movie);
      if (number !== shown || ended.size < movies.length) return;
      if (!complete) setReady(true, "");
      complete = true;
      begin();
    });
  }
  setReady(false, "Watch both to the end.");
  begin();
}

function vote(choice, ms) {
  votes.push({ choice, ms });
  store(`votes/${participant}`, JSON.stringify(votes));
  showTrial();
}

function choose(side) {
  if (!element("trial").hidden && ready && performance.now() - readyAt >= NOT_BEFORE) {
    ready = false;
    vote(side, Math.round(performance.now() - readyAt));
  }
}

function showWelcome() {
  participant = null;
  store("current", "");
  const given = /^#([1-9][0-9]{0,8})$/.exec(location.hash);
  element("participant").value = given ? given[1] : "";
  element("consent").checked = false;
  const kinds = ["picture", "movie"].filter(kind => study.pairs.some(pair => pair.kind === kind));
  element("kinds").textContent = kinds.map(kind => `${kind}s`).join(" and ");
  element("movies-note").hidden = !kinds.includes("movie");
  element("count").textContent = plan(study, 1).length;
  element("sources").textContent = study.sources.join(" · ");
  show("welcome");
}

function begin(number) {
  participant = number;
  trials = plan(study, number);
  votes = votesOf(number) ?? [];
  store("current", String(number));
  store(`votes/${number}`, JSON.stringify(votes));
  showTrial();
}

function showEnd() {
  shown++;  // stops what is loading or playing
  element("left").replaceChildren();
  element("right").replaceChildren();
  const complete = votes.length >= trials.length;
  element("end-title").textContent = complete ? "Thank you" : "Stopped";
  element("end-text").textContent = complete
    ? "You have judged all pairs. Please save the votes and hand the file to whoever invited you."
    : `You have judged ${votes.length} of ${trials.length} pairs. You can save these votes, or continue.`;
  element("continue").hidden = complete;
  element("next").hidden = !complete;
  element("done").textContent = "";
  element("csv").value = csvOf(study, participant, votes);
  show("end");
}

function save() {
  const link = document.createElement("a");
  const blob = new Blob([csvOf(study, participant, votes)], { type: "text/csv" });
  link.href = URL.createObjectURL(blob);
  link.download = `votes-${study.id}-${participant}.csv`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  element("done").textContent = `Saved as ${link.download}.`;
}

async function copy() {
  const text = element("csv");
  try {
    await navigator.clipboard.writeText(text.value);
  } catch {  // only secure pages may; the old way needs the text in sight
    text.closest("details").open = true;
    text.select();
    document.execCommand("copy");
  }
  element("done").textContent = "Copied.";
}

element("enter").addEventListener("submit", event => {
  event.preventDefault();
  const given = element("participant").value;
  // Without a number: one that no organiser gives, and that two devices hardly share.
  const random = 1e8 + crypto.getRandomValues(new Uint32Array(1))[0] % 8e8;
  begin(given ? Number(given) : random);
});
element("choose-left").addEventListener("click", () => choose("left"));
element("choose-right").addEventListener("click", () => choose("right"));
element("skip").addEventListener("click", () => vote("skipped", 0));
element("stop").addEventListener("click", showEnd);
element("continue").addEventListener("click", showTrial);
element("save").addEventListener("click", save);
element("copy").addEventListener("click", copy);
element("next").addEventListener("click", showWelcome);
document.addEventListener("keydown", event => {
  if (event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "1") choose("left");
  if (event.key === "2") choose("right");
});

const given = /^#([1-9][0-9]{0,8})$/.exec(location.hash)?.[1];
const current = stored("current");
if (current === undefined) element("no-storage").hidden = false;
if (current && (!given || given === current)) begin(Number(current));
else showWelcome();
