// Keys, pointer and wheel.

import { get, make } from "./dom.js";
import { CAMERAS, changeRate, duration, seek, stepFlight, togglePlay } from "./player.js";

const STEP = 0.1; // s by an arrow key
const FINE = 0.02; // s by a comma or full stop: one control step
const TURN = 0.06; // of the picture's height, by Shift and an arrow key

const HELP = [
  ["Space", "play or pause"], ["\u2190 \u2192", "0.1 s back or on"], [", .", "one control step back or on"],
  ["+ \u2212", "faster or slower"], ["R", "to the start"], ["N P", "next or previous flight"],
  ["C", "camera: follow, top, free"], ["Shift + arrows", "turn the camera; drag does it, too"],
  ["Page up, down", "nearer or farther; the wheel does it, too"], ["0", "camera as it was at first"],
  ["T", "trails coloured by speed or by flight"], ["O", "surface that the drone's centre must not cross"],
  ["L", "light or dark"], ["H", "hide or show the panels"], ["?", "this list"],
];

export function nextCamera(store) {
  store.change({ camera: CAMERAS[(CAMERAS.indexOf(store.state.camera) + 1) % CAMERAS.length] });
}

export function listenToKeys(store, data, view, actions) {
  get("keys").append(...HELP.flatMap(([key, meaning]) => [make("dt", "", key), make("dd", "", meaning)]));
  const by = (step) => seek(store, data, store.state.time + step);
  const turn = (dx, dy) => { view.drag(dx, dy, store.state, false); store.change({}); };
  const zoom = (factor) => { view.zoom(factor); store.change({}); };
  const keys = {
    " ": () => togglePlay(store, data), k: () => togglePlay(store, data), ArrowLeft: () => by(-STEP),
    ArrowRight: () => by(STEP), ",": () => by(-FINE), ".": () => by(FINE), Home: () => store.change({ time: 0 }),
    End: () => store.change({ time: duration(data, store.state) }), "+": () => changeRate(store, 1),
    "=": () => changeRate(store, 1), "-": () => changeRate(store, -1), r: () => store.change({ time: 0 }),
    n: () => stepFlight(store, data, 1), p: () => stepFlight(store, data, -1), c: () => nextCamera(store),
    PageUp: () => zoom(0.85), PageDown: () => zoom(1 / 0.85), 0: () => { view.reset(); store.change({}); },
    t: () => store.change({ bySpeed: !store.state.bySpeed }), o: () => store.change({ shells: !store.state.shells }),
    l: actions.theme, h: actions.panels, "?": actions.help,
  };
  const turns = { ArrowLeft: [TURN, 0], ArrowRight: [-TURN, 0], ArrowUp: [0, TURN], ArrowDown: [0, -TURN] };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || get("help").open) return;
    const onControl = event.target.closest?.("button, input[type=checkbox]");
    if (onControl && (event.key === " " || event.key === "Enter")) return; // these press it
    if (event.shiftKey && turns[event.key]) turn(...turns[event.key]);
    else {
      const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
      if (!act) return;
      act();
    }
    event.preventDefault();
  });
  // A click with the mouse leaves no focus behind, so that the space bar plays and does not press the button again.
  document.addEventListener("click", (event) => {
    if (event.detail > 0) event.target.closest?.("button")?.blur();
  });
}

/** Drag turns or moves, two fingers and the wheel zoom. */
export function listenToPointer(canvas, store, view) {
  const fingers = new Map();
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const gap = fingers.size === 2 ? spread() : 0;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const height = canvas.clientHeight;
    const pan = event.shiftKey || event.buttons === 2 || fingers.size === 2;
    const part = 1 / fingers.size; // two fingers that move together are one movement
    view.drag(((event.clientX - before.x) / height) * part, ((event.clientY - before.y) / height) * part, store.state, pan);
    if (gap > 0) view.zoom(gap / Math.max(spread(), 1));
    store.change({});
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    view.zoom(Math.exp(Math.min(Math.max(event.deltaY, -100), 100) * 0.0015));
    store.change({});
  }, { passive: false });
}
