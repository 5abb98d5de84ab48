// Three cameras: behind the drone, from above, and free around a point.

import { PerspectiveCamera, Vector3 } from "./three/three.min.js";
import { heading, sample } from "./flight.js";

const FIELD_OF_VIEW = 52; // degrees, of the shorter side of the picture: phones see as much as screens
const TOP_FIELD = 14; // degrees: from far above, so that trees hardly lean
const CHASE = { distance: 4.2, pitch: 0.24 }; // m and rad: above and behind, with the drone below the middle
const NEAR = 0.05; // m, nearest that is drawn
const AIM = 0.55; // m above the drone that the chasing camera looks at
const PITCH = { least: -0.15, most: 1.5 }; // rad above the horizon

/** A camera rig: `look(state, flight)` places its camera, `drag`, `zoom` and `reset` are the viewer's hands. */
export function createCamera(course, flights) {
  const camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, NEAR, 2000);
  camera.up.set(0, 0, 1);
  const box = extent(flights);
  const hands = {};
  const eye = new Vector3();
  const target = new Vector3();
  const room = { width: 1, height: 1, right: 0, down: 0, wide: 1, tall: 1 }; // what the panels leave free
  let wide = FIELD_OF_VIEW;

  function reset() {
    Object.assign(hands, { yaw: 0, pitch: 0, zoom: 1, panX: 0, panY: 0 });
  }

  function chase(state, flight) {
    const now = sample(flight, state.time);
    const [vx, vy] = heading(flight, state.time);
    const yaw = Math.atan2(vy, vx) + Math.PI + hands.yaw;
    const pitch = clamp(CHASE.pitch + hands.pitch);
    const distance = CHASE.distance * hands.zoom * (camera.aspect < 0.8 ? 1.25 : 1);
    target.set(...now.position).add(new Vector3(0, 0, AIM));
    orbit(yaw, pitch, distance);
    eye.z = Math.max(eye.z, 0.15);
  }

  function above() {
    const [width, depth] = [box.size.x, box.size.y].map((size) => size + 5);
    target.set(box.centre.x + hands.panX, box.centre.y + hands.panY, 0);
    const upright = room.wide < room.tall && width > depth; // a long course stands upright on a phone
    const [across, along] = upright ? [depth, width] : [width, depth];
    lens(TOP_FIELD, 2);
    const half = tangent();
    const height = Math.max(along / room.tall, across / room.wide) / 2 / half * hands.zoom + box.centre.z;
    eye.set(target.x, target.y, height);
    camera.up.set(upright ? 1 : 0, upright ? 0 : 1, 0);
  }

  function free() {
    const half = tangent() * Math.min(room.tall, room.wide);
    const reach = Math.hypot(box.size.x, box.size.y, box.size.z) / 2;
    target.set(box.centre.x + hands.panX, box.centre.y + hands.panY, 0);
    const yaw = (camera.aspect < 1 && box.size.x > box.size.y ? Math.PI : -Math.PI / 2 - 0.45) + hands.yaw;
    orbit(yaw, clamp(0.62 + hands.pitch), ((0.82 * reach) / half) * hands.zoom);
  }

  function lens(field, near) {
    if (camera.fov === field && camera.near === near) return;
    Object.assign(camera, { fov: field, near });
    camera.updateProjectionMatrix();
  }

  function tangent() {
    return Math.tan((camera.fov * Math.PI) / 360);
  }

  function orbit(yaw, pitch, distance) {
    eye.set(Math.cos(yaw) * Math.cos(pitch), Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch));
    eye.multiplyScalar(distance).add(target);
  }

  reset();
  return {
    camera,
    reset,
    /** Half the picture's height at a distance of 1. */
    tangent,
    look(state, flight) {
      camera.up.set(0, 0, 1);
      lens(wide, NEAR);
      const aside = state.camera === "follow" ? 0 : room.right;
      camera.setViewOffset(room.width, room.height, aside, room.down, room.width, room.height);
      ({ follow: () => chase(state, flight), top: above, free })[state.camera]();
      camera.position.copy(eye);
      camera.lookAt(target);
      return state.camera === "follow" ? eye.distanceTo(target) : 0;
    },
    /** `free` are the edges of the part of the picture that no panel covers, CSS pixels. */
    resize(width, height, free) {
      camera.aspect = width / height;
      const [right, down] = [(width - free.left - free.right) / 2, (height - free.top - free.bottom) / 2];
      const [across, along] = [free.right - free.left, free.bottom - free.top];
      Object.assign(room, { width, height, right, down, wide: across / height, tall: along / height });
      const half = Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
      wide = (Math.atan(camera.aspect < 1 ? half / Math.max(camera.aspect, 0.62) : half) * 360) / Math.PI;
      camera.updateProjectionMatrix();
    },
    /** Drag by shares of the picture's height; panning moves the floor under the pointer. */
    drag(dx, dy, mode, pan) {
      if (mode === "top" || (pan && mode === "free")) {
        const distance = eye.distanceTo(target) * 2 * tangent();
        const right = new Vector3().setFromMatrixColumn(camera.matrixWorld, 0);
        const up = new Vector3().setFromMatrixColumn(camera.matrixWorld, 1);
        hands.panX += (-dx * right.x + dy * up.x) * distance;
        hands.panY += (-dx * right.y + dy * up.y) * distance;
      } else {
        hands.yaw -= dx * 3;
        hands.pitch += dy * 2;
      }
    },
    zoom(factor) { hands.zoom = Math.min(Math.max(hands.zoom * factor, 0.12), 6); },
  };
}

function clamp(pitch) {
  return Math.min(Math.max(pitch, PITCH.least), PITCH.most);
}

/** The box around all flown paths and gates. */
function extent(flights) {
  const low = new Vector3(Infinity, Infinity, Infinity);
  const high = low.clone().negate();
  const include = (point) => { low.min(point); high.max(point); };
  for (const flight of flights) {
    flight.waypoints.forEach((gate) => include(new Vector3(...gate)));
    for (let i = 0; i < flight.steps; i += 1) {
      const point = new Vector3(flight.columns.px[i], flight.columns.py[i], flight.columns.pz[i]);
      if (Number.isFinite(point.x + point.y + point.z)) include(point);
    }
  }
  return { centre: low.clone().add(high).multiplyScalar(0.5), size: high.clone().sub(low) };
}
