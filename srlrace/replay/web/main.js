// The page: data, state, view and controls, put together.

import { css, speedRamp } from "./colours.js";
import { loadData } from "./data.js";
import { fixed, get, make, prepare, setText } from "./dom.js";
import { createHud } from "./hud.js";
import { listenToKeys, listenToPointer, nextCamera } from "./input.js";
import { createList } from "./list.js";
import { CAMERAS, createStore, duration, startClock } from "./player.js";
import { createTimeline } from "./timeline.js";
import { createView2D } from "./view2d.js";
import { createView3D } from "./view3d.js";

const CAMERA_NAMES = { follow: "Follow", top: "Top", free: "Free" };
const COURSE_NAMES = { split_s: "Split-S", split_s_cpc: "Split-S (CPC)" };
const NARROW = 820; // CSS pixels: below, the list of flights is closed at first

const data = loadData(get("data").textContent);
const view = createView(data);
const store = createStore(initialState(data));

/** WebGL where it works; a canvas on which it failed half-way gives no other picture, so a fresh one takes its place. */
function createView(loaded) {
  const found = createView3D(get("view"), loaded);
  get("fallback").hidden = found !== null;
  if (found) return found;
  get("view").replaceWith(get("view").cloneNode(true));
  return createView2D(get("view"), loaded);
}

/** What a link may set after #, as in #t=2.5&camera=top&play=0, and defaults. */
function initialState(loaded) {
  const asked = new URLSearchParams(location.hash.slice(1));
  const visible = new Set(loaded.flights.filter((flight) => flight.visible).map((flight) => flight.index));
  const several = loaded.flights.filter((flight) => flight.visible && !flight.ghost).length > 1;
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const state = {
    time: 0, rate: 1, playing: asked.get("play") !== "0" && !still, visible,
    focus: loaded.flights.findIndex((flight) => flight.visible), camera: several ? "free" : "follow",
    bySpeed: !several, shells: false, theme: matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark",
  };
  if (CAMERAS.includes(asked.get("camera"))) state.camera = asked.get("camera");
  if (["light", "dark"].includes(asked.get("theme"))) state.theme = asked.get("theme");
  const time = Number(asked.get("t"));
  if (asked.has("t") && Number.isFinite(time)) state.time = Math.min(Math.max(time, 0), duration(loaded, state));
  return state;
}

function describe() {
  const { course, runs } = data;
  const plain = course.name.replaceAll("_", " ");
  const track = COURSE_NAMES[course.name] ?? plain.charAt(0).toUpperCase() + plain.slice(1);
  setText(get("course"), track);
  const names = runs.map((run) => run.name).join(" \u00b7 ");
  setText(get("policy"), names);
  get("policy").title = names;
  setText(get("fastest"), fixed(data.maxSpeed, 1));
  get("view").setAttribute("aria-label", `${track}: ${data.flights.length} flights, ${view.kind} view. `
    + "Drag, or Shift and the arrow keys, turn the camera.");
}

function drawButtons(state) {
  label(get("camera"), "Camera ", CAMERA_NAMES[state.camera]);
  get("shells").setAttribute("aria-pressed", String(state.shells));
  label(get("colouring"), "Trails ", state.bySpeed ? "By speed" : "By flight");
  setText(get("theme"), state.theme === "dark" ? "Light" : "Dark");
  get("theme").setAttribute("aria-label", `Change to ${state.theme === "dark" ? "light" : "dark"}`);
  get("legend").hidden = !state.bySpeed;
}

/** A button's name, and the value that stands alone where there is little room. */
function label(button, name, value) {
  if (!button.firstChild) button.append(make("span", "what", name), make("span"));
  setText(button.lastChild, value);
}

function drawRamp(theme) {
  const prepared = prepare(get("ramp"));
  if (prepared === null) return;
  const { pen, width, height } = prepared;
  const paint = pen.createLinearGradient(0, 0, width, 0);
  speedRamp(theme).forEach((colour, index, all) => paint.addColorStop(index / (all.length - 1), css(colour)));
  pen.fillStyle = paint;
  pen.fillRect(0, 0, width, height);
}

function applyTheme(theme) {
  document.documentElement.dataset.theme = theme;
  view.theme(theme);
  drawRamp(theme);
}

function toggleTheme() {
  store.change({ theme: store.state.theme === "dark" ? "light" : "dark" });
}

function openHelp() {
  store.change({ playing: false });
  get("help").showModal();
}

function togglePanels() {
  document.body.classList.toggle("bare");
  window.dispatchEvent(new Event("resize"));
}

function showFlights(open) {
  get("flights").hidden = !open;
  get("flights-button").setAttribute("aria-expanded", String(open));
  window.dispatchEvent(new Event("resize"));
}

/** Edges of the part of the picture that no panel covers, CSS pixels. */
function freeRoom() {
  const [width, height] = [window.innerWidth, window.innerHeight];
  const box = (id) => get(id).getBoundingClientRect();
  if (document.body.classList.contains("bare")) return { left: 0, top: 0, right: width, bottom: box("transport").top };
  const narrow = width <= NARROW;
  const right = get("flights").hidden || narrow ? width : box("flights").left;
  return { left: 0, top: box("tools").bottom, right, bottom: box(narrow ? "hud" : "transport").top };
}

function wireButtons() {
  get("camera").addEventListener("click", () => nextCamera(store));
  get("shells").addEventListener("click", () => store.change({ shells: !store.state.shells }));
  get("colouring").addEventListener("click", () => store.change({ bySpeed: !store.state.bySpeed }));
  get("theme").addEventListener("click", toggleTheme);
  get("help-button").addEventListener("click", openHelp);
  get("help-close").addEventListener("click", () => get("help").close());
  get("flights-button").addEventListener("click", () => showFlights(get("flights").hidden));
  matchMedia("(prefers-color-scheme: light)").addEventListener("change", (event) => {
    store.change({ theme: event.matches ? "light" : "dark" });
  });
}

function start() {
  describe();
  wireButtons();
  createList(store, data);
  listenToKeys(store, data, view, { theme: toggleTheme, help: openHelp, panels: togglePanels });
  listenToPointer(get("view"), store, view);
  const drawHud = createHud(data);
  const drawTimeline = createTimeline(store, data);
  const fit = () => {
    view.resize(window.innerWidth, window.innerHeight, freeRoom());
    drawRamp(store.state.theme);
    store.change({});
  };
  store.listen((state, values) => { if (values.theme) applyTheme(values.theme); });
  window.addEventListener("resize", fit);
  applyTheme(store.state.theme);
  showFlights(window.innerWidth > NARROW);
  startClock(store, data, (state) => {
    drawButtons(state);
    view.draw(state);
    drawHud(state);
    drawTimeline(state);
    const page = document.documentElement.dataset;
    page.interactive ??= String(Math.round(performance.now())); // ms from the start of loading to the first frame
    page.view = view.kind;
    page.time = String(state.time);
  });
}

start();
