// Gates: the sphere within which one counts as passed, a ring around it across the course, a stem and a number.

import {
  CanvasTexture, Color, CylinderGeometry, Group, Mesh, MeshBasicMaterial, SphereGeometry, Sprite, SpriteMaterial,
  SRGBColorSpace, TorusGeometry, Quaternion, Vector3,
} from "./three/three.min.js";
import { SCENE } from "./colours.js";

const RING = 0.85; // m, radius of the ring; only the sphere inside counts
const LABEL = 0.1; // height of a number, as a share of half the picture's

/** The gates of one flight at a time: an evaluation moves some of them from episode to episode. */
export function createGates(course) {
  const group = new Group();
  const sets = new Map();
  let look = "dark";

  function gatesOf(flight) {
    if (!sets.has(flight)) sets.set(flight, flight.waypoints.map((_, index) => createGate(course, flight.waypoints, index)));
    return sets.get(flight);
  }

  return {
    objects: [group],
    draw(flight, passed, tangent) {
      const gates = gatesOf(flight);
      if (group.children[0] !== gates[0].group) {
        group.clear();
        group.add(...gates.map((gate) => gate.group));
      }
      const next = course.sequence[passed];
      const done = new Set(course.sequence.slice(0, passed));
      gates.forEach((gate, index) => gate.show(index === next ? "next" : done.has(index) ? "passed" : "coming", look, tangent));
    },
    theme(theme) { look = theme; },
  };
}

function createGate(course, waypoints, index) {
  const group = new Group();
  const paint = new MeshBasicMaterial({ transparent: true });
  const glass = new MeshBasicMaterial({ transparent: true, depthWrite: false });
  const ring = new Mesh(new TorusGeometry(RING, 0.035, 10, 64), paint);
  ring.quaternion.setFromUnitVectors(new Vector3(0, 0, 1), across(course, waypoints, index));
  const ball = new Mesh(new SphereGeometry(course.passingRadius, 24, 16), glass);
  const [x, y, z] = waypoints[index];
  const stemLength = Math.max(z - RING * 0.98, 0.05);
  const stem = new Mesh(new CylinderGeometry(0.012, 0.012, stemLength, 6).rotateX(Math.PI / 2), paint);
  stem.position.z = -z + stemLength / 2;
  const label = new Sprite(new SpriteMaterial({ transparent: true, depthTest: false, sizeAttenuation: false }));
  label.center.set(0.5, -0.15);
  label.position.z = RING;
  label.renderOrder = 8;
  group.position.set(x, y, z);
  group.add(ring, ball, stem, label);
  return {
    group,
    show(status, theme, tangent) {
      label.scale.set(LABEL * tangent, LABEL * tangent, 1);
      const colour = new Color(SCENE[theme][status]);
      paint.color = colour;
      glass.color = colour;
      paint.opacity = { next: 1, coming: 0.75, passed: 0.45 }[status];
      glass.opacity = { next: 0.5, coming: 0.2, passed: 0.12 }[status];
      ring.scale.setScalar(status === "next" ? 1.12 : 1);
      label.material.map = number(index + 1, theme, status);
      label.material.opacity = status === "passed" ? 0.55 : 1;
    },
  };
}

/** Direction in which a gate is flown through: between those from the gate before and to the one after. */
function across(course, waypoints, index) {
  const order = course.sequence;
  const at = Math.max(order.indexOf(index), 0);
  const point = (k) => new Vector3(...waypoints[order[Math.min(Math.max(k, 0), order.length - 1)]]);
  const here = point(at);
  const before = at > 0 || course.laps === 0 ? point(at - 1) : point(course.gates - 1);
  const into = here.clone().sub(before);
  const onward = point(at + 1).sub(here);
  const sum = into.lengthSq() ? into.normalize() : new Vector3();
  if (onward.lengthSq()) sum.add(onward.normalize());
  return sum.lengthSq() > 1e-3 ? sum.normalize() : new Vector3(1, 0, 0);
}

const numbers = new Map();

/** A gate's number on a disc; each is painted once. */
function number(value, theme, status) {
  const key = `${value} ${theme} ${status}`;
  if (!numbers.has(key)) numbers.set(key, paintNumber(value, theme, status));
  return numbers.get(key);
}

function paintNumber(value, theme, status) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 96;
  const pen = canvas.getContext("2d");
  const colours = SCENE[theme];
  pen.beginPath();
  pen.arc(48, 48, 38, 0, 2 * Math.PI);
  pen.fillStyle = status === "next" ? colours.next : colours.plate;
  pen.fill();
  pen.lineWidth = 5;
  pen.strokeStyle = colours[status];
  pen.stroke();
  pen.fillStyle = status === "next" ? (theme === "dark" ? "#16110a" : "#ffffff") : colours.label;
  pen.font = "700 46px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.fillText(String(value), 48, 51);
  const texture = new CanvasTexture(canvas);
  texture.colorSpace = SRGBColorSpace;
  return texture;
}
