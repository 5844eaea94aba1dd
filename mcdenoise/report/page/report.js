"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const element = (id) => document.getElementById(id);

/* Which plots and tables are shown. */

function showChosen() {
  const view = element("view").value;
  const chosen = document.querySelector("input[name=metric]:checked")?.value;
  for (const part of document.querySelectorAll("[data-view]")) {
    const { view: ofView, metric } = part.dataset;
    part.hidden = ofView !== view || (metric !== undefined && metric !== chosen);
  }
}

element("choice").addEventListener("change", showChosen);
element("choice").addEventListener("submit", (event) => event.preventDefault());
showChosen();

/* Tables that sort: by the numbers of a column, or its texts; rows without figures stay last. */

function sortTable(table, heading) {
  const headings = [...heading.parentElement.children];
  const column = headings.indexOf(heading);
  const direction = heading.ariaSort === "ascending" ? "descending" : "ascending";
  for (const other of headings) other.ariaSort = other === heading ? direction : "none";
  const sign = direction === "ascending" ? 1 : -1;
  const value = (row) => {
    const cell = row.classList.contains("unknown") ? undefined : row.cells[column];
    if (column === 0) return cell?.textContent.trim();
    return cell === undefined || cell.dataset.value === "" ? undefined : Number(cell.dataset.value);
  };
  const compare = (first, second) => {
    const [a, b] = [value(first), value(second)];
    if (a === undefined || b === undefined) return (a === undefined) - (b === undefined);
    return sign * (column === 0 ? a.localeCompare(b, "en", { numeric: true }) : a - b);
  };
  const body = table.tBodies[0];
  body.append(...[...body.rows].sort(compare));
}

for (const table of document.querySelectorAll("table.sortable")) {
  // Where there is little room, each row is a card, and each figure has the name of its column above it.
  const names = [...table.tHead.rows[0].cells].map((cell) => cell.textContent.trim());
  for (const row of table.tBodies[0].rows) [...row.cells].forEach((cell, column) => (cell.dataset.label = names[column]));
  for (const heading of table.tHead.rows[0].cells) {
    heading.querySelector("button").addEventListener("click", () => sortTable(table, heading));
  }
}

/* From radiance to what a display shows. */

const encodeSrgb = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
const TONE_CURVES = {
  srgb: (x) => encodeSrgb(Math.min(x, 1)),
  linear: (x) => x,
  reinhard: (x) => encodeSrgb(x / (1 + x)),
  // Narkowicz 2015, a fit of the ACES reference rendering.
  aces: (x) => encodeSrgb(Math.min((x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14), 1)),
};
const SMAPE_EPSILON = 0.01;

/** What each of the 256 codes looks like. */
function toneTable(exposure, tone) {
  return Uint8ClampedArray.from(data.linear, (x) => 255 * TONE_CURVES[tone](x * 2 ** exposure));
}

/** SMAPE of one pixel against another, both given by the place of their first code. */
function smape(codes, reference, place) {
  let sum = 0;
  for (let channel = place; channel < place + 3; channel++) {
    const [x, y] = [data.linear[codes[channel]], data.linear[reference[channel]]];
    sum += Math.abs(x - y) / (x + y + SMAPE_EPSILON);
  }
  return sum / 3;
}

/* The comparer. */

if (element("stage")) startComparer();

function startComparer() {
  const stage = element("stage");
  const seam = element("seam");
  const canvas = stage.querySelector("canvas");
  const context = canvas.getContext("2d");
  const REFERENCE = "reference";
  const SIDES = ["left", "right", "reference"];
  const LARGEST_PIXEL = 48;
  const STACKED_BELOW = 640;
  const GAP = 4;
  const FRAME_MILLISECONDS = 100;

  // center is in pixels of the picture; zoom 1 fits it into its pane.
  const state = { scene: 0, frame: null, left: "", right: "", exposure: 0, tone: "srgb", show: "picture" };
  Object.assign(state, { layout: "beside", seam: 0.5, zoom: 1, center: { x: 0, y: 0 } });
  const sides = { left: null, right: null, reference: null };
  const decoded = new Map();
  let cursor = null;
  let request = 0;
  let playing = null;

  const scene = () => data.scenes[state.scene];
  const frameNumber = () => scene().frames[state.frame];
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  /** Codes of a picture as RGBA, and a canvas of its size; the last few pictures are kept. */
  async function picture(name) {
    const file = scene().pictures[name]?.[frameNumber()];
    if (file === undefined) return null;
    const key = `${state.scene}/${frameNumber()}/${name}`;
    if (!decoded.has(key)) {
      const image = new Image();
      image.src = file;
      await image.decode();
      const surface = new OffscreenCanvas(scene().width, scene().height);
      const drawing = surface.getContext("2d", { willReadFrequently: true });
      drawing.drawImage(image, 0, 0);
      const codes = drawing.getImageData(0, 0, surface.width, surface.height).data;
      decoded.set(key, { name, codes, surface, look: "" });
      const kept = Math.max(32, SIDES.length * scene().frames.length);
      if (decoded.size > kept) decoded.delete(decoded.keys().next().value);
    }
    return decoded.get(key);
  }

  /** Paint a picture's own canvas as it is to be shown. */
  function develop(side) {
    const reference = sides.reference;
    const look = `${state.show} ${state.exposure} ${state.tone}`;
    if (side === null || side.look === look) return;
    const { codes, surface } = side;
    const result = new ImageData(surface.width, surface.height);
    const pixels = result.data;
    if (state.show === "error" && reference) {
      const last = data.heat.length - 1;
      for (let place = 0; place < codes.length; place += 4) {
        const error = smape(codes, reference.codes, place);
        const [red, green, blue] = data.heat[Math.min(Math.round((error / data.heatEnd) * last), last)];
        pixels[place] = red;
        pixels[place + 1] = green;
        pixels[place + 2] = blue;
        pixels[place + 3] = 255;
      }
    } else {
      const table = toneTable(state.exposure, state.tone);
      for (let place = 0; place < codes.length; place += 4) {
        pixels[place] = table[codes[place]];
        pixels[place + 1] = table[codes[place + 1]];
        pixels[place + 2] = table[codes[place + 2]];
        pixels[place + 3] = 255;
      }
    }
    surface.getContext("2d").putImageData(result, 0, 0);
    side.look = look;
  }

  const stacked = () => stage.parentElement.clientWidth < STACKED_BELOW;

  /** Where each picture is painted: side by side or one below the other, or two of them at one place under a seam. */
  function panes() {
    const [width, height] = [stage.clientWidth, stage.clientHeight];
    if (state.layout === "seam") {
      const split = state.seam * width;
      const whole = { x: 0, y: 0, width, height };
      return [
        { ...whole, name: "left", start: 0, end: split },
        { ...whole, name: "right", start: split, end: width },
      ];
    }
    const across = (width - 2 * GAP) / 3;
    const down = (height - 2 * GAP) / 3;
    return SIDES.map((name, index) => {
      const pane = stacked()
        ? { name, x: 0, y: index * (down + GAP), width, height: Math.max(down, 0) }
        : { name, x: index * (across + GAP), y: 0, width: Math.max(across, 0), height };
      return { ...pane, start: pane.x, end: pane.x + pane.width };
    });
  }

  /** A place on the stage as one in its pane. */
  function inPane({ x, y }) {
    const all = panes();
    const pane = all.find((one) => x < one.x + one.width + GAP && y < one.y + one.height + GAP) ?? all.at(-1);
    return { x: x - pane.x, y: y - pane.y };
  }

  const fitScale = () => Math.min(panes()[0].width / scene().width, panes()[0].height / scene().height);
  const scale = () => fitScale() * state.zoom;
  const clampZoom = (zoom) => clamp(zoom, 1, Math.max(LARGEST_PIXEL / fitScale(), 1));

  function keepInside() {
    state.zoom = clampZoom(state.zoom);
    const { width, height } = panes()[0];
    for (const [axis, size, room] of [
      ["x", scene().width, width],
      ["y", scene().height, height],
    ]) {
      const half = Math.min(room / scale() / 2, size / 2);
      state.center[axis] = clamp(state.center[axis], half, size - half);
    }
  }

  function paint() {
    // Hidden, it has no size to paint for.
    if (fitScale() === 0) return;
    keepInside();
    const ratio = window.devicePixelRatio;
    const [width, height] = [Math.round(stage.clientWidth * ratio), Math.round(stage.clientHeight * ratio)];
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    context.clearRect(0, 0, width, height);
    const perPixel = scale() * ratio;
    context.imageSmoothingEnabled = perPixel < 1;
    for (const pane of panes()) {
      const side = sides[pane.name];
      develop(side);
      if (side === null) continue;
      const [start, end] = [Math.round(pane.start * ratio), Math.round(pane.end * ratio)];
      const [x, y] = [(pane.x + pane.width / 2) * ratio, (pane.y + pane.height / 2) * ratio];
      context.save();
      context.beginPath();
      context.rect(start, pane.y * ratio, end - start, pane.height * ratio);
      context.clip();
      context.translate(x - state.center.x * perPixel, y - state.center.y * perPixel);
      context.drawImage(side.surface, 0, 0, scene().width * perPixel, scene().height * perPixel);
      context.restore();
    }
    describe();
  }

  function describe() {
    const percent = Math.round(100 * state.seam);
    seam.style.left = `${100 * state.seam}%`;
    seam.ariaValueNow = String(percent);
    seam.ariaValueText = `${percent} %: ${state.left} left, ${state.right} right`;
    stage.dataset.scale = scale().toFixed(3);
    stage.style.touchAction = state.zoom > 1 ? "none" : "pan-y";
    stage.classList.toggle("zoomed", state.zoom > 1);
    for (const pane of panes()) {
      const tag = stage.querySelector(`.tag.${pane.name}`);
      const name = state[pane.name] ?? REFERENCE;
      tag.textContent = sides[pane.name] ? name : `${name}: none of this frame`;
      const atEnd = state.layout === "seam" && pane.name === "right";
      tag.style.left = atEnd ? "auto" : `${pane.x + 8}px`;
      tag.style.top = `${pane.y + 8}px`;
      tag.style.maxWidth = `${(state.layout === "seam" ? 0.47 : 0.9) * pane.width}px`;
    }
    element("legend").hidden = state.show !== "error";
    element("frame-name").textContent = `${frameNumber()} (${state.frame + 1} of ${scene().frames.length})`;
    element("exposure-name").textContent = `${state.exposure < 0 ? "−" : "+"}${Math.abs(state.exposure)} EV`;
    element("zoom-name").textContent = `${scale().toFixed(scale() < 10 ? 1 : 0)}×`;
    readOut();
  }

  /** Values of the pixel under the cursor, or else of the one in the middle. */
  function readOut() {
    const place = cursor ? toPicture(cursor) : state.center;
    const x = clamp(Math.floor(place.x), 0, scene().width - 1);
    const y = clamp(Math.floor(place.y), 0, scene().height - 1);
    const start = 4 * (y * scene().width + x);
    const three = (value) => (value === 0 ? "0" : value.toPrecision(3));
    element("pixel").textContent = `${x}, ${y}${cursor ? "" : " (middle)"}`;
    const rows = [
      [state.left, sides.left],
      [state.right, sides.right],
      [REFERENCE, sides.reference],
    ];
    [...element("readout").tBodies[0].rows].forEach((row, index) => {
      const [name, side] = rows[index];
      const values = side ? [0, 1, 2].map((channel) => three(data.linear[side.codes[start + channel]])) : ["–", "–", "–"];
      const error = side && sides.reference ? smape(side.codes, sides.reference.codes, start).toFixed(3) : "–";
      [name, ...values, error].forEach((text, column) => (row.cells[column].textContent = text));
    });
  }

  /** Read the pictures that the state asks for, then paint; a later request overtakes an earlier one. */
  async function update() {
    const own = ++request;
    delete stage.dataset.ready;
    for (const id of ["frame", "exposure", "tone", "left", "right"]) element(id).value = state[id];
    element("scene").value = state.scene;
    for (const name of ["show", "layout"]) {
      for (const input of document.querySelectorAll(`input[name=${name}]`)) input.checked = input.value === state[name];
    }
    layOut();
    const [left, right, reference] = await Promise.all([state.left, state.right, REFERENCE].map(picture));
    if (own !== request) return;
    Object.assign(sides, { left, right, reference });
    const lacking = state.show === "error" && !reference;
    stage.classList.toggle("lacking", lacking);
    for (const side of [left, right]) if (side && lacking) side.look = "";
    paint();
    stage.dataset.ready = String(own);
  }

  function change(changes) {
    Object.assign(state, changes);
    return update();
  }

  function layOut() {
    const [across, down] = state.layout === "seam" ? [1, 1] : stacked() ? [1, 3] : [3, 1];
    const ratio = (across * scene().width) / (down * scene().height);
    stage.style.aspectRatio = String(ratio);
    stage.style.setProperty("--ratio", ratio);
    stage.dataset.layout = state.layout;
  }

  function openScene(index, changes = {}) {
    const exposure = index === state.scene && state.left ? state.exposure : data.scenes[index].exposure;
    state.scene = index;
    const names = Object.keys(scene().pictures);
    for (const side of ["left", "right"]) {
      element(side).replaceChildren(...names.map((name, place) => new Option(`${place + 1}  ${name}`, name)));
    }
    const wanted = { left: state.left || data.first[0], right: state.right || data.first[1], ...changes };
    for (const side of ["left", "right"]) if (!names.includes(wanted[side])) wanted[side] = names.at(side === "left" ? 0 : -1);
    element("frame").max = scene().frames.length - 1;
    const frame = clamp(wanted.frame ?? state.frame ?? scene().start, 0, scene().frames.length - 1);
    const center = { x: scene().width / 2, y: scene().height / 2 };
    change({ zoom: 1, center, exposure, ...wanted, frame });
  }

  /* Zoom and pan: what is under the pointer stays under it. */

  function toPicture(onTheStage) {
    const place = inPane(onTheStage);
    const pane = panes()[0];
    return {
      x: state.center.x + (place.x - pane.width / 2) / scale(),
      y: state.center.y + (place.y - pane.height / 2) / scale(),
    };
  }

  function onStage(event) {
    const box = stage.getBoundingClientRect();
    return { x: event.clientX - box.left - stage.clientLeft, y: event.clientY - box.top - stage.clientTop };
  }

  function zoomBy(factor, at = { x: panes()[0].width / 2, y: panes()[0].height / 2 }) {
    if (fitScale() === 0) return;
    const fixed = toPicture(at);
    state.zoom = clampZoom(state.zoom * factor);
    const moved = toPicture(at);
    panBy(moved.x - fixed.x, moved.y - fixed.y);
  }

  function panBy(x, y) {
    if (fitScale() === 0) return;
    state.center = { x: state.center.x - x, y: state.center.y - y };
    paint();
  }

  function moveSeam(place) {
    state.seam = clamp(place, 0, 1);
    paint();
  }

  stage.addEventListener(
    "wheel",
    (event) => {
      if (!event.ctrlKey && !event.metaKey && !stage.contains(document.activeElement)) return;
      event.preventDefault();
      zoomBy(2 ** (-event.deltaY * (event.deltaMode === 1 ? 0.05 : 0.002)), onStage(event));
    },
    { passive: false },
  );

  const pointers = new Map();
  let dragsSeam = false;
  stage.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    stage.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, onStage(event));
    if (pointers.size > 1) return;
    dragsSeam = state.layout === "seam" && (event.target === seam || state.zoom === 1);
    (event.target === seam ? seam : stage).focus({ preventScroll: true });
    event.preventDefault();
    if (dragsSeam) moveSeam(onStage(event).x / stage.clientWidth);
  });
  stage.addEventListener("pointermove", (event) => {
    cursor = onStage(event);
    const before = pointers.get(event.pointerId);
    if (before === undefined) return readOut();
    const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    pointers.set(event.pointerId, cursor);
    if (others.length > 0) {
      const distance = (place) => Math.hypot(place.x - others[0].x, place.y - others[0].y);
      const middle = { x: (cursor.x + others[0].x) / 2, y: (cursor.y + others[0].y) / 2 };
      zoomBy(distance(cursor) / Math.max(distance(before), 1), middle);
      panBy((cursor.x - before.x) / 2 / scale(), (cursor.y - before.y) / 2 / scale());
    } else if (dragsSeam) {
      moveSeam(cursor.x / stage.clientWidth);
    } else {
      panBy((cursor.x - before.x) / scale(), (cursor.y - before.y) / scale());
    }
  });
  for (const name of ["pointerup", "pointercancel"]) {
    stage.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  stage.addEventListener("pointerleave", () => {
    cursor = null;
    readOut();
  });

  /* Controls and keys. */

  const step = (by) => change({ frame: clamp(state.frame + by, 0, scene().frames.length - 1) });
  const play = async () => {
    const own = playing ? null : {};
    playing = own;
    element("play").textContent = own ? "❚❚" : "▶";
    element("play").ariaLabel = own ? "Pause" : "Play";
    while (own && playing === own) {
      await change({ frame: (state.frame + 1) % scene().frames.length });
      await new Promise((done) => setTimeout(done, FRAME_MILLISECONDS));
    }
  };
  const expose = (by) => change({ exposure: clamp(state.exposure + by, -8, 8) });
  const swap = () => change({ left: state.right, right: state.left });
  const nextTone = () => {
    const tones = Object.keys(TONE_CURVES);
    change({ tone: tones[(tones.indexOf(state.tone) + 1) % tones.length] });
  };
  const fit = () => {
    state.zoom = 1;
    paint();
  };

  element("scene").addEventListener("change", (event) => openScene(Number(event.target.value)));
  for (const id of ["left", "right", "tone"]) {
    element(id).addEventListener("change", (event) => change({ [id]: event.target.value }));
  }
  for (const id of ["frame", "exposure"]) {
    element(id).addEventListener("input", (event) => change({ [id]: Number(event.target.value) }));
  }
  for (const input of document.querySelectorAll("input[name=show], input[name=layout]")) {
    input.addEventListener("change", () => change({ [input.name]: input.value }));
  }
  element("swap").addEventListener("click", swap);
  element("play").addEventListener("click", play);
  element("earlier").addEventListener("click", () => step(-1));
  element("later").addEventListener("click", () => step(1));
  element("in").addEventListener("click", () => zoomBy(1.5));
  element("out").addEventListener("click", () => zoomBy(1 / 1.5));
  element("fit").addEventListener("click", fit);

  const KEYS = {
    "+": () => zoomBy(1.5),
    "=": () => zoomBy(1.5),
    "-": () => zoomBy(1 / 1.5),
    0: fit,
    ",": () => step(-1),
    ".": () => step(1),
    "[": () => expose(-0.5),
    "]": () => expose(0.5),
    "\\": () => change({ exposure: scene().exposure }),
    " ": play,
    e: () => change({ show: state.show === "error" ? "picture" : "error" }),
    s: () => change({ layout: state.layout === "seam" ? "beside" : "seam" }),
    t: nextTone,
    x: swap,
  };
  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

  function arrow(event) {
    const [across, down] = ARROWS[event.key];
    const far = event.shiftKey ? 5 : 1;
    if (event.target === stage && state.zoom > 1) {
      panBy((-across * far * 40) / scale(), (-down * far * 40) / scale());
    } else if (across !== 0 && state.layout === "seam") {
      moveSeam(state.seam + across * far * 0.02);
    } else {
      return false;
    }
    return true;
  }

  stage.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const digit = /^Digit([1-9])$/.exec(event.code);
    const name = digit && Object.keys(scene().pictures)[Number(digit[1]) - 1];
    let handled = true;
    if (event.key in ARROWS) {
      handled = arrow(event);
    } else if (event.target === seam && (event.key === "Home" || event.key === "End")) {
      moveSeam(event.key === "Home" ? 0 : 1);
    } else if (name) {
      change({ [event.shiftKey ? "left" : "right"]: name });
    } else if (event.key.toLowerCase() in KEYS) {
      KEYS[event.key.toLowerCase()]();
    } else {
      handled = false;
    }
    if (handled) event.preventDefault();
  });

  for (const button of document.querySelectorAll("button.crop")) {
    button.addEventListener("click", () => {
      const { scene: name, frame, method, center, width } = button.dataset;
      const index = data.scenes.findIndex((one) => one.name === name);
      const [x, y] = center.split(" ").map(Number);
      const shrunk = data.scenes[index].width / Number(button.dataset.whole);
      const left = method === REFERENCE ? state.left : REFERENCE;
      openScene(index, { left, right: method, frame: data.scenes[index].frames.indexOf(Number(frame)) });
      state.center = { x: x * shrunk, y: y * shrunk };
      state.zoom = Number(button.dataset.whole) / Number(width) / 2;
      element("compare").scrollIntoView();
      stage.focus({ preventScroll: true });
    });
  }

  new ResizeObserver(() => {
    layOut();
    paint();
  }).observe(stage);
  openScene(0);
}
