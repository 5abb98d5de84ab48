// The numbers of the flight in focus.

import { flightColour } from "./colours.js";
import { fixed, get, make, setText } from "./dom.js";
import { passedAt, sample } from "./flight.js";

const NEAR = 0.15; // m more than the forbidden distance: a clearance that is marked
const ROTORS = [["FL", 0], ["FR", 1], ["BL", 3], ["BR", 2]]; // as seen from above, nose up
const WORDS = { finished: "Finished", crashed: "Crashed", out_of_bounds: "Out of bounds", timeout: "Timeout", diverged: "Diverged" };

export function outcomeWord(outcome) {
  return WORDS[outcome] ?? outcome;
}

/** The time that counts, in words: the lap's, or that to the last gate; an outcome where there is none. */
export function resultText(flight) {
  return flight.official === null ? outcomeWord(flight.outcome) : `${flight.official.toFixed(2)} s`;
}

export function flightName(flight, data) {
  if (flight.ghost) return flight.label;
  return data.runs.length > 1 ? `${flight.run.name} · ${flight.label.toLowerCase()}` : flight.label;
}

export function createHud(data) {
  const rotors = ROTORS.map(([label, rotor]) => ({ rotor, ...meter(get("thrust").querySelector(".rotors"), label) }));
  const axes = ["x", "y", "z"].map((label) => meter(get("rates").querySelector(".axes"), label, true));
  setText(get("gates"), `/ ${data.course.sequence.length}`);
  get("lap-cell").hidden = data.course.laps === 0;

  return function draw(state) {
    const flight = data.flights[state.focus];
    const now = sample(flight, state.time);
    drawNumbers(flight, now, passedAt(flight, state.time), state);
    for (const { rotor, bar, value } of rotors) {
      bar.style.transform = `scaleX(${share(now.thrusts[rotor] / data.course.thrustMax)})`;
      setText(value, fixed(now.thrusts[rotor], 1));
    }
    const total = now.thrusts.reduce((sum, thrust) => sum + thrust, 0);
    setText(get("thrust-sum"), fixed(total / data.course.mass / data.course.gravity, 2));
    axes.forEach(({ bar, mark, value }, axis) => {
      const most = data.course.rateMax[axis];
      const rate = Math.min(Math.max(now.rates[axis] / most, -1), 1) || 0;
      bar.style.transform = `scaleX(${rate})`;
      mark.style.left = `${50 + 50 * (Math.min(Math.max(now.command[axis + 1] / most, -1), 1) || 0)}%`;
      setText(value, fixed(now.rates[axis], 1));
    });
  };

  function drawNumbers(flight, now, passed, state) {
    const ended = now.done && flight.finish !== null;
    setText(get("speed"), fixed(now.speed, 1));
    setText(get("time"), fixed(ended ? flight.finish : now.time, 2));
    setText(get("gate"), String(passed));
    setText(get("clearance"), fixed(now.clearance, 2));
    get("clearance-cell").hidden = !flight.columns.clearance.some(Number.isFinite);
    get("clearance-cell").classList.toggle("near", now.clearance < data.course.keepOut + NEAR);
    if (data.course.laps > 0) setText(get("lap"), lapText(flight, passed, ended ? flight.finish : now.time));
    setText(get("pilot-name"), flightName(flight, data));
    const shown = now.done ? outcomeWord(flight.outcome) : "";
    setText(get("outcome"), shown);
    get("outcome").className = flight.outcome === "finished" ? "good" : "bad";
    get("hud").style.setProperty("--flight", flightColour(flight, state.theme));
  }

  function lapText(flight, passed, time) {
    if (passed === 0) return "\u2013";
    if (passed === data.course.sequence.length && flight.official !== null) return fixed(flight.official, 2);
    const lap = Math.floor((passed - 1) / data.course.gates) * data.course.gates;
    return fixed(time - flight.passes[lap], 2);
  }
}

function meter(parent, label, centred = false) {
  const bar = make("i");
  const mark = make("b");
  const value = make("span", "value");
  const box = make("span", "meter", bar);
  if (centred) box.append(mark);
  parent.append(make("div", "row", make("span", "label", label), box, value));
  return { bar, mark, value };
}

function share(value) {
  return Math.min(Math.max(value, 0), 1) || 0;
}
