// What the page shows at this moment, and the clock that moves it on.

export const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
export const CAMERAS = ["follow", "top", "free"];

/** The page's state; `change(values)` sets some of it and tells whoever listens. */
export function createStore(initial) {
  const listeners = [];
  const state = { ...initial };
  return {
    state,
    change(values) {
      Object.assign(state, values);
      listeners.forEach((listener) => listener(state, values));
    },
    listen(listener) { listeners.push(listener); },
  };
}

/** Longest of the flights that are shown, s. */
export function duration(data, state) {
  return Math.max(0.02, ...data.flights.filter((flight) => state.visible.has(flight.index)).map((f) => f.duration));
}

/** Move the store's time with the wall clock while it plays; calls `draw` for each frame that differs. */
export function startClock(store, data, draw) {
  let before = null;
  let dirty = true;
  store.listen(() => { dirty = true; });
  const frame = (now) => {
    const { state } = store;
    if (state.playing && before !== null) advance(store, data, (now - before) / 1000);
    before = state.playing ? now : null;
    if (dirty) {
      dirty = false;
      draw(state);
    }
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
}

function advance(store, data, elapsed) {
  const { state } = store;
  const end = duration(data, state);
  const time = state.time + Math.min(elapsed, 0.25) * state.rate; // a sleeping tab does not skip the flight
  store.change(time >= end ? { time: end, playing: false } : { time });
}

export function togglePlay(store, data) {
  const { state } = store;
  const ended = state.time >= duration(data, state) - 1e-6;
  store.change(state.playing ? { playing: false } : { playing: true, time: ended ? 0 : state.time });
}

export function seek(store, data, time) {
  store.change({ time: Math.min(Math.max(time, 0), duration(data, store.state)) });
}

export function changeRate(store, by) {
  const index = SPEEDS.indexOf(store.state.rate) + by;
  store.change({ rate: SPEEDS[Math.min(Math.max(index, 0), SPEEDS.length - 1)] });
}

/** Look at a flight: alone, unless it is one of several that are shown. */
export function focusFlight(store, data, index) {
  const { state } = store;
  const ghosts = data.flights.filter((flight) => flight.ghost && state.visible.has(flight.index)).map((f) => f.index);
  const visible = state.visible.has(index) ? state.visible : new Set([index, ...ghosts]);
  store.change({ focus: index, visible, time: Math.min(state.time, duration(data, { ...state, visible })) });
}

/** Show a flight beside the others, or take it away; the last one stays. */
export function toggleFlight(store, data, index) {
  const visible = new Set(store.state.visible);
  if (visible.has(index)) visible.delete(index);
  else visible.add(index);
  if (visible.size === 0) return;
  const focus = visible.has(store.state.focus) ? store.state.focus : [...visible][0];
  store.change({ visible, focus });
}

export function stepFlight(store, data, by) {
  const count = data.flights.length;
  focusFlight(store, data, (store.state.focus + by + count) % count);
}
