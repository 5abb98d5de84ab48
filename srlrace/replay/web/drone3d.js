// The quadrotor: an X of four arms at its true size, with a bar over each rotor as long as its thrust.

import {
  BoxGeometry, CircleGeometry, Color, CylinderGeometry, DoubleSide, Group, Mesh, MeshBasicMaterial,
  MeshLambertMaterial, Quaternion, SphereGeometry, TorusGeometry, Vector3,
} from "./three/three.min.js";
import { SCENE, flightColour } from "./colours.js";

// Front left, front right, back right, back left: the order of the recorded thrusts.
const CORNERS = [[1, 1], [1, -1], [-1, -1], [-1, 1]];
const BAR = 0.42; // m, length of the bar at full thrust
const SEEN = 0.028; // least size of an arm, as a share of half the picture: far drones are drawn larger

export function createDrone(flight, course) {
  const arm = course.armLength;
  const group = new Group();
  const body = material(flight);
  const mark = material(flight);
  const bars = new MeshBasicMaterial({ transparent: true, opacity: flight.ghost ? 0 : 0.9, depthWrite: false });
  const discs = new MeshBasicMaterial({ transparent: true, opacity: flight.ghost ? 0.1 : 0.22, side: DoubleSide, depthWrite: false });
  addFrame(group, arm, body, mark);
  const thrusts = CORNERS.map(([x, y]) => addRotor(group, [x * arm * Math.SQRT1_2, y * arm * Math.SQRT1_2], arm, { body, mark: x > 0 ? mark : body, bars, discs }));
  const crash = cross(arm);
  const shadow = new Mesh(new CircleGeometry(1, 24), new MeshBasicMaterial({ color: 0x000000, transparent: true, opacity: 0.28, depthWrite: false }));
  shadow.renderOrder = 1;
  return {
    objects: [group, shadow, crash],
    draw(now, eye, tangent, drawn) {
      for (const object of [group, shadow, crash]) object.visible = drawn;
      if (!drawn || !now.position.every(Number.isFinite)) return;
      group.position.set(...now.position);
      group.quaternion.copy(new Quaternion(...now.attitude)).normalize();
      const scale = Math.max(1, (eye.distanceTo(group.position) * tangent * SEEN) / arm);
      group.scale.setScalar(scale);
      now.thrusts.forEach((thrust, rotor) => {
        thrusts[rotor].scale.z = Math.max(0.001, (BAR * thrust) / course.thrustMax);
      });
      shadow.position.set(now.position[0], now.position[1], 0.02);
      shadow.scale.setScalar(scale * arm * 1.5);
      shadow.material.opacity = 0.3 / (1 + 0.25 * Math.max(0, now.position[2]));
      shadow.visible = drawn && !flight.ghost;
      crash.visible = drawn && now.done && !["finished", "timeout"].includes(flight.outcome) && !flight.ghost;
      crash.position.copy(group.position);
      crash.scale.setScalar(scale);
      crash.quaternion.copy(eyeward(eye, group.position));
    },
    theme(theme) {
      const own = flight.ghost ? SCENE[theme].ghost : flightColour(flight, theme);
      body.color = new Color(flight.ghost ? own : SCENE[theme].drone);
      mark.color = new Color(own);
      mark.emissive = new Color(own).multiplyScalar(0.25);
      bars.color = new Color(SCENE[theme].thrust);
      discs.color = new Color(own);
      crash.children.forEach((part) => { part.material.color = new Color(SCENE[theme].accent); });
    },
  };
}

function material(flight) {
  const ghost = { transparent: flight.ghost, opacity: flight.ghost ? 0.45 : 1, depthWrite: !flight.ghost };
  return new MeshLambertMaterial(ghost);
}

function addFrame(group, arm, body, mark) {
  const hull = new Mesh(new BoxGeometry(arm * 0.72, arm * 0.42, arm * 0.26), body);
  const nose = new Mesh(new SphereGeometry(arm * 0.13, 16, 12), mark);
  nose.position.set(arm * 0.4, 0, arm * 0.04);
  const deck = new Mesh(new BoxGeometry(arm * 0.46, arm * 0.26, arm * 0.12), mark);
  deck.position.z = arm * 0.18;
  group.add(hull, nose, deck);
  for (const turn of [Math.PI / 4, -Math.PI / 4]) {
    const beam = new Mesh(new BoxGeometry(arm * 2, arm * 0.11, arm * 0.07), body);
    beam.rotation.z = turn;
    group.add(beam);
  }
}

/** A motor with its ring and disc; returns the bar whose length is the thrust. */
function addRotor(group, [x, y], arm, { body, mark, bars, discs }) {
  const motor = new Mesh(new CylinderGeometry(arm * 0.1, arm * 0.12, arm * 0.2, 12), body);
  const ring = new Mesh(new TorusGeometry(arm * 0.5, arm * 0.028, 8, 36), mark);
  const disc = new Mesh(new CircleGeometry(arm * 0.48, 32), discs);
  const bar = new Mesh(new CylinderGeometry(arm * 0.07, arm * 0.07, 1, 10).rotateX(Math.PI / 2).translate(0, 0, 0.5), bars);
  motor.rotation.x = Math.PI / 2;
  for (const [part, z] of [[motor, 0.1], [ring, 0.22], [disc, 0.22], [bar, 0.26]]) {
    part.position.set(x, y, z * arm);
    group.add(part);
  }
  return bar;
}

/** Where a flight ended badly: a cross that faces the viewer. */
function cross(arm) {
  const group = new Group();
  for (const turn of [Math.PI / 4, -Math.PI / 4]) {
    const bar = new Mesh(new BoxGeometry(arm * 4.4, arm * 0.5, arm * 0.1), new MeshBasicMaterial({ depthTest: false, transparent: true }));
    bar.rotation.z = turn;
    bar.renderOrder = 9;
    group.add(bar);
  }
  return group;
}

function eyeward(eye, position) {
  return new Quaternion().setFromUnitVectors(new Vector3(0, 0, 1), eye.clone().sub(position).normalize());
}
