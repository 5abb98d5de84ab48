// A flight at any time between its states.

/** Index i and share s in 0..1 such that the time lies between states i and i + 1; ends are held. */
export function place(flight, time) {
  const times = flight.time;
  const last = flight.steps - 1;
  if (!(time > times[0]) || last === 0) return [0, 0];
  if (time >= times[last]) return [last - 1, 1];
  let low = 0;
  let high = last;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle;
    else high = middle;
  }
  return [low, (time - times[low]) / (times[low + 1] - times[low])];
}

/** Position, velocity, attitude, rates, thrusts, command and clearance at a time; `done` after the last state. */
export function sample(flight, time) {
  const [i, share] = place(flight, time);
  const at = (name) => mix(flight.columns[name], i, share);
  return {
    time: Math.min(Math.max(time, 0), flight.duration),
    position: hermite(flight, i, share),
    velocity: [at("vx"), at("vy"), at("vz")],
    speed: at("speed"),
    attitude: attitude(flight.columns, i, share),
    rates: [at("wx"), at("wy"), at("wz")],
    thrusts: [at("f0"), at("f1"), at("f2"), at("f3")],
    command: held(flight.columns, share > 0 && flight.steps > 1 ? i + 1 : i),
    clearance: at("clearance"),
    done: time >= flight.duration,
  };
}

/** How many gates have been passed at a time. */
export function passedAt(flight, time) {
  let count = 0;
  while (count < flight.passes.length && flight.passes[count] <= time + 1e-6) count += 1;
  return count;
}

/** Direction of flight around a time, smooth enough to hang a camera on. */
export function heading(flight, time, span = 0.5) {
  const sum = [0, 0, 0];
  for (let k = -4; k <= 4; k += 1) {
    const [i, share] = place(flight, time + (k * span) / 4);
    ["vx", "vy", "vz"].forEach((name, axis) => { sum[axis] += mix(flight.columns[name], i, share) || 0; });
  }
  return sum;
}

function mix(column, i, share) {
  return share === 0 ? column[i] : column[i] + (column[i + 1] - column[i]) * share;
}

/** Commands hold for a whole step and are stored with the state that the step led to. */
function held(columns, i) {
  return ["ac", "ax", "ay", "az"].map((name) => columns[name][i]);
}

function hermite(flight, i, s) {
  const { columns, time } = flight;
  if (s === 0 || flight.steps === 1) return ["px", "py", "pz"].map((name) => columns[name][i]);
  const h = time[i + 1] - time[i];
  const [a, b] = [s * s * (3 - 2 * s), s * (1 - s)];
  return [["px", "vx"], ["py", "vy"], ["pz", "vz"]].map(([p, v]) => {
    const [p0, p1] = [columns[p][i], columns[p][i + 1]];
    return p0 + (p1 - p0) * a + h * b * ((1 - s) * columns[v][i] - s * columns[v][i + 1]);
  });
}

/** Quaternion [x, y, z, w], body to world. */
function attitude(columns, i, share) {
  const names = ["qx", "qy", "qz", "qw"];
  const from = names.map((name) => columns[name][i]);
  if (share === 0) return from;
  const to = names.map((name) => columns[name][i + 1]);
  const sign = from.reduce((dot, value, k) => dot + value * to[k], 0) < 0 ? -1 : 1;
  const mixed = from.map((value, k) => value + (sign * to[k] - value) * share);
  const norm = Math.hypot(...mixed) || 1;
  return mixed.map((value) => value / norm);
}
