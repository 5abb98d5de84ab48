// Playback: buttons, the scrubber, the gates' times and the speed above it.

import { speedCss, speedRamp } from "./colours.js";
import { fixed, get, icon, make, prepare, setText } from "./dom.js";
import { place } from "./flight.js";
import { changeRate, duration, seek, SPEEDS, togglePlay } from "./player.js";

const PLAY = "M7 4.5v15l13-7.5z";
const PAUSE = "M6 4.5h4.2v15H6zM13.8 4.5H18v15h-4.2z";
const RESTART = "M5 4.5h3v15H5zM20 4.5v15L9 12z";

export function createTimeline(store, data) {
  const [play, scrub] = [get("play"), get("scrub")];
  const icons = { true: icon(PAUSE), false: icon(PLAY) };
  get("restart").append(icon(RESTART));
  get("restart").addEventListener("click", () => store.change({ time: 0 }));
  play.addEventListener("click", () => togglePlay(store, data));
  get("rate").addEventListener("click", () => {
    if (store.state.rate === SPEEDS.at(-1)) store.change({ rate: SPEEDS[0] });
    else changeRate(store, 1);
  });
  scrub.addEventListener("input", () => seek(store, data, Number(scrub.value)));
  let drawn = "";

  function draw(state) {
    const end = duration(data, state);
    scrub.max = String(end);
    scrub.value = String(state.time);
    scrub.setAttribute("aria-valuetext", `${fixed(state.time, 2)} of ${fixed(end, 2)} seconds`);
    setText(get("clock"), `${fixed(state.time, 2)} / ${fixed(end, 2)} s`);
    setText(get("rate"), `${state.rate}\u00d7`);
    get("rate").setAttribute("aria-label", `Playback speed ${state.rate}`);
    if (play.firstChild !== icons[state.playing]) play.replaceChildren(icons[state.playing]);
    play.setAttribute("aria-label", state.playing ? "Pause" : "Play");
    const look = `${state.focus} ${end} ${state.theme} ${window.innerWidth} ${window.innerHeight}`;
    if (look !== drawn) {
      drawn = look;
      drawProfile(data, state, end);
      drawTicks(data.flights[state.focus], end);
    }
  }
  return draw;
}

/** Speed over time of the flight in focus. */
function drawProfile(data, state, end) {
  const prepared = prepare(get("profile"));
  if (prepared === null) return;
  const { pen, width, height } = prepared;
  const flight = data.flights[state.focus];
  const ramp = speedRamp(state.theme);
  pen.clearRect(0, 0, width, height);
  for (let x = 0; x < width; x += 1) {
    const time = (x / width) * end;
    if (time > flight.duration) break;
    const share = flight.columns.speed[place(flight, time)[0]] / data.maxSpeed;
    const tall = Math.max(1, share * height);
    pen.fillStyle = speedCss(ramp, share);
    pen.fillRect(x, height - tall, 1.2, tall);
  }
}

function drawTicks(flight, end) {
  const ticks = flight.passes.map((time) => {
    const tick = make("i");
    tick.style.left = `${(100 * time) / end}%`;
    return tick;
  });
  get("ticks").replaceChildren(...ticks);
}
