// The list of flights: a disc shows or hides one beside the others, its name brings it into focus.

import { flightColour } from "./colours.js";
import { get, make, setText } from "./dom.js";
import { flightName, outcomeWord, resultText } from "./hud.js";
import { focusFlight, toggleFlight } from "./player.js";

export function createList(store, data) {
  const rows = data.flights.map((flight) => createRow(store, data, flight));
  const groups = data.runs.length > 1 ? data.runs.map((run, index) => [run.name, index]) : [[null, 0]];
  for (const [heading, run] of groups) {
    if (heading !== null) get("list").append(make("li", "heading", heading));
    for (const row of rows) if (row.flight.run === data.runs[run]) get("list").append(row.item);
  }
  for (const row of rows) if (row.flight.ghost) get("list").append(row.item);
  setText(get("summary"), data.runs.length > 1 ? `${data.runs.length} policies` : summary(data.runs[0]));
  store.listen((state) => rows.forEach((row) => row.draw(state)));
  rows.forEach((row) => row.draw(store.state));
}

function summary(run) {
  return `${run.finished} of ${run.episodes} episodes finished${run.suite ? ` on ${run.suite}` : ""}`;
}

function createRow(store, data, flight) {
  const box = make("input");
  box.type = "checkbox";
  box.setAttribute("aria-label", `Show ${flightName(flight, data)}`);
  box.addEventListener("change", () => toggleFlight(store, data, flight.index));
  const bad = flight.outcome !== "finished";
  const result = make("span", bad ? "result bad" : "result", resultText(flight));
  result.title = outcomeWord(flight.outcome);
  const button = make("button", "", make("span", "", flight.label), result);
  button.type = "button";
  button.addEventListener("click", () => focusFlight(store, data, flight.index));
  const item = make("li", "", make("label", "", box), button);
  return {
    flight,
    item,
    draw(state) {
      box.checked = state.visible.has(flight.index);
      button.setAttribute("aria-current", String(state.focus === flight.index));
      item.style.setProperty("--flight", flightColour(flight, state.theme));
    },
  };
}
