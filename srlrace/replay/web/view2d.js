// The flights from above, for browsers without WebGL.

import { flightColour, SCENE, speedCss, speedRamp } from "./colours.js";
import { passedAt, place, sample } from "./flight.js";

const MARGIN = 2; // m around the world
const FOLLOWED = 14; // m, shorter side of the picture when it follows the drone

export function createView2D(canvas, data) {
  const pen = canvas.getContext("2d");
  const { low, high } = data.course;
  const view = { width: 1, height: 1, ratio: 1, theme: "dark", zoom: 1, panX: 0, panY: 0 };

  /** Metres to pixels; a long course stands upright on a tall screen. */
  function projection(state) {
    const upright = view.height > view.width && high[0] - low[0] > high[1] - low[1];
    const spans = [high[0] - low[0] + 2 * MARGIN, high[1] - low[1] + 2 * MARGIN];
    const [across, along] = upright ? [spans[1], spans[0]] : spans;
    const fit = Math.min(view.width / across, view.height / along);
    const close = state.camera === "follow" ? Math.max(fit, Math.min(view.width, view.height) / FOLLOWED) : fit;
    const scale = close * view.zoom;
    const centre = state.camera === "follow" ? sample(data.flights[state.focus], state.time).position
      : [(low[0] + high[0]) / 2 + view.panX, (low[1] + high[1]) / 2 + view.panY];
    const to = ([x, y]) => {
      const [dx, dy] = [(x - centre[0]) * scale, (y - centre[1]) * scale];
      return upright ? [view.width / 2 - dy, view.height / 2 - dx] : [view.width / 2 + dx, view.height / 2 - dy];
    };
    return { to, scale };
  }

  function disc(at, radius, fill, stroke = null) {
    pen.beginPath();
    pen.arc(at[0], at[1], Math.max(radius, 0), 0, 2 * Math.PI);
    if (fill) { pen.fillStyle = fill; pen.fill(); }
    if (stroke) { pen.strokeStyle = stroke; pen.stroke(); }
  }

  function square({ to, scale }, [x, y], half, fill) {
    const [cx, cy] = to([x, y]);
    pen.fillStyle = fill;
    pen.fillRect(cx - half * scale, cy - half * scale, 2 * half * scale, 2 * half * scale);
  }

  function drawObstacles(lens, scene, colours, shells) {
    const keep = data.course.keepOut;
    if (shells) {
      pen.globalAlpha = 0.3;
      for (const [x, y, , r] of [...scene.sphere, ...scene.cylinder]) disc(lens.to([x, y]), (r + keep) * lens.scale, colours.shell);
      for (const [x, y, , edge] of scene.box) square(lens, [x, y], edge / 2 + keep, colours.shell);
      pen.globalAlpha = 1;
    }
    for (const [x, y, , r] of [...scene.sphere, ...scene.cylinder]) disc(lens.to([x, y]), r * lens.scale, colours.obstacle);
    for (const [x, y, , edge] of scene.box) square(lens, [x, y], edge / 2, colours.obstacle);
  }

  function drawGates(lens, flight, passed, colours) {
    const order = data.course.sequence;
    const done = new Set(order.slice(0, passed));
    flight.waypoints.forEach((gate, index) => {
      const status = index === order[passed] ? "next" : done.has(index) ? "passed" : "coming";
      const at = lens.to(gate);
      pen.lineWidth = 2;
      disc(at, 11, status === "next" ? colours.next : colours.plate, colours[status]);
      pen.fillStyle = status === "next" ? colours.plate : colours.label;
      pen.font = "600 12px Inter, system-ui, sans-serif";
      pen.textAlign = "center";
      pen.textBaseline = "middle";
      pen.fillText(String(index + 1), at[0], at[1] + 0.5);
    });
  }

  function drawTrail(lens, flight, state, ramp) {
    const [now] = place(flight, state.time);
    const plain = flightColour(flight, view.theme);
    pen.lineWidth = state.focus === flight.index ? 3 : 2;
    pen.setLineDash(flight.ghost ? [6, 5] : []);
    for (let i = 0; i < flight.steps - 1; i += 1) {
      pen.globalAlpha = i < now ? 1 : 0.2;
      pen.strokeStyle = state.bySpeed && !flight.ghost ? speedCss(ramp, flight.columns.speed[i] / data.maxSpeed) : plain;
      pen.beginPath();
      pen.moveTo(...lens.to([flight.columns.px[i], flight.columns.py[i]]));
      pen.lineTo(...lens.to([flight.columns.px[i + 1], flight.columns.py[i + 1]]));
      pen.stroke();
    }
    pen.globalAlpha = 1;
    pen.setLineDash([]);
  }

  function drawDrone(lens, flight, state, colours) {
    const now = sample(flight, state.time);
    const at = lens.to(now.position);
    const ahead = lens.to([now.position[0] + now.velocity[0], now.position[1] + now.velocity[1]]);
    const turn = Math.atan2(ahead[1] - at[1], ahead[0] - at[0]);
    pen.save();
    pen.translate(...at);
    pen.rotate(turn);
    pen.beginPath();
    [[13, 0], [-8, 8], [-4, 0], [-8, -8]].forEach((point) => pen.lineTo(...point));
    pen.closePath();
    pen.fillStyle = flightColour(flight, view.theme);
    pen.strokeStyle = colours.plate;
    pen.lineWidth = 2;
    pen.fill();
    pen.stroke();
    pen.restore();
  }

  function draw(state) {
    const colours = SCENE[view.theme];
    const lens = projection(state);
    const focus = data.flights[state.focus];
    pen.setTransform(view.ratio, 0, 0, view.ratio, 0, 0);
    pen.fillStyle = colours.sky;
    pen.fillRect(0, 0, view.width, view.height);
    const corners = [lens.to([low[0], low[1]]), lens.to([high[0], high[1]])];
    const [x, y] = [0, 1].map((axis) => Math.min(corners[0][axis], corners[1][axis]));
    const [w, h] = [0, 1].map((axis) => Math.abs(corners[0][axis] - corners[1][axis]));
    pen.fillStyle = colours.floor;
    pen.fillRect(x, y, w, h);
    pen.strokeStyle = colours.bounds;
    pen.strokeRect(x, y, w, h);
    drawObstacles(lens, data.scenes[focus.scene], colours, state.shells);
    const shown = data.flights.filter((flight) => state.visible.has(flight.index));
    const ramp = speedRamp(view.theme);
    for (const flight of shown) drawTrail(lens, flight, state, ramp);
    drawGates(lens, focus, passedAt(focus, state.time), colours);
    for (const flight of shown) drawDrone(lens, flight, state, colours);
  }

  return {
    kind: "2D",
    draw,
    drag(dx, dy, state) {
      if (state.camera === "follow") return;
      const { scale } = projection(state);
      view.panX -= (dx * view.height) / scale;
      view.panY += (dy * view.height) / scale;
    },
    zoom(factor) { view.zoom = Math.min(Math.max(view.zoom / factor, 0.3), 12); },
    reset() { Object.assign(view, { zoom: 1, panX: 0, panY: 0 }); },
    resize(width, height) {
      view.ratio = Math.min(window.devicePixelRatio || 1, 2);
      Object.assign(view, { width, height });
      canvas.width = Math.round(width * view.ratio);
      canvas.height = Math.round(height * view.ratio);
    },
    theme(theme) { view.theme = theme; },
  };
}
