// From the page's JSON to typed arrays.

const COLUMNS = [
  "px", "py", "pz", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "wx", "wy", "wz", "f0", "f1", "f2", "f3",
  "ac", "ax", "ay", "az", "clearance",
];
const MISSING = 65535; // stands for a value that is not a number

export function loadData(text) {
  const data = JSON.parse(text);
  data.flights = data.flights.map((flight, index) => decodeFlight(flight, index, data));
  data.maxSpeed = Math.max(1, ...data.flights.map((flight) => flight.maxSpeed));
  return data;
}

function decodeFlight(packed, index, data) {
  const { steps } = packed;
  const levels = new Uint16Array(bytes(packed.values));
  const columns = {};
  COLUMNS.forEach((name, row) => {
    const [low, step] = packed.scale[row];
    columns[name] = Float64Array.from(levels.subarray(row * steps, (row + 1) * steps), (level) =>
      level === MISSING ? NaN : low + step * level);
  });
  columns.speed = Float64Array.from(columns.vx, (vx, i) => Math.hypot(vx, columns.vy[i], columns.vz[i]));
  const flight = {
    ...packed, index, columns,
    time: new Float32Array(bytes(packed.time)),
    target: new Uint16Array(bytes(packed.target)),
    official: packed.official,
    maxSpeed: columns.speed.reduce((most, speed) => (speed > most ? speed : most), 0),
    run: data.runs[packed.run] ?? null,
    values: null,
  };
  flight.duration = flight.time[steps - 1];
  flight.passes = passes(flight, data.course);
  flight.label = flight.ghost ? "Time-optimal reference" : `Episode ${flight.episode}`;
  return flight;
}

/** Times at which gates were passed, s: where the target changes, and the end of a finished flight. */
function passes(flight, course) {
  const times = [];
  for (let i = 1; i < flight.steps; i += 1) {
    if (flight.target[i] !== flight.target[i - 1]) times.push(flight.time[i]);
  }
  if (flight.outcome === "finished" && times.length < course.sequence.length) {
    times.push(flight.finish ?? flight.duration);
  }
  return times;
}

function bytes(base64) {
  const text = atob(base64);
  const out = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i += 1) out[i] = text.charCodeAt(i);
  return out.buffer;
}
