// The flown path as a ribbon of constant width on the screen, coloured by speed or by flight.

import { BufferAttribute, BufferGeometry, Color, DoubleSide, Mesh, ShaderMaterial, Vector2, Vector3 } from "./three/three.min.js";
import { flightColour, speedRamp } from "./colours.js";

const WIDTH = 3.2; // CSS pixels at a picture 800 pixels high

const VERTEX = `
attribute vec3 tangent; attribute float side; attribute float speed; attribute float moment;
uniform vec2 resolution; uniform float width;
varying float vSpeed; varying float vMoment; varying float vSide;
void main() {
  vec4 here = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  vec4 ahead = projectionMatrix * modelViewMatrix * vec4(position + tangent, 1.0);
  vec2 along = (ahead.xy / max(ahead.w, 1e-3) - here.xy / max(here.w, 1e-3)) * resolution;
  vec2 across = length(along) > 1e-5 ? normalize(vec2(-along.y, along.x)) : vec2(0.0, 1.0);
  here.xy += across * side * width / resolution * here.w;
  gl_Position = here;
  vSpeed = speed; vMoment = moment; vSide = side;
}`;

const FRAGMENT = `
uniform float now; uniform bool bySpeed; uniform vec3 flat_colour; uniform vec3 ramp[8]; uniform float ahead;
uniform float dash; uniform float strength;
varying float vSpeed; varying float vMoment; varying float vSide;
vec3 speedColour(float share) {
  float place = clamp(share, 0.0, 1.0) * 7.0;
  vec3 colour = ramp[0];
  for (int i = 0; i < 7; i++) colour = mix(colour, ramp[i + 1], clamp(place - float(i), 0.0, 1.0));
  return colour;
}
void main() {
  if (dash > 0.0 && fract(vMoment / dash) > 0.55) discard;
  float edge = 1.0 - smoothstep(0.7, 1.0, abs(vSide));
  float flown = 1.0 - smoothstep(now - 0.004, now + 0.004, vMoment);
  float alpha = mix(ahead, strength, flown) * edge;
  if (alpha < 0.01) discard;
  gl_FragColor = vec4(bySpeed ? speedColour(vSpeed) : flat_colour, alpha);
}`;

export function createTrail(flight, maxSpeed) {
  const material = new ShaderMaterial({
    vertexShader: VERTEX, fragmentShader: FRAGMENT, transparent: true, depthWrite: false, side: DoubleSide,
    uniforms: {
      resolution: { value: new Vector2(1, 1) }, width: { value: WIDTH }, now: { value: 0 }, bySpeed: { value: true },
      flat_colour: { value: new Vector3() }, ramp: { value: Array.from({ length: 8 }, () => new Vector3()) },
      ahead: { value: 0.16 }, dash: { value: flight.ghost ? 0.09 : 0 }, strength: { value: flight.ghost ? 0.75 : 1 },
    },
  });
  const mesh = new Mesh(ribbon(flight, maxSpeed), material);
  mesh.frustumCulled = false;
  mesh.renderOrder = 3;
  const values = material.uniforms;
  return {
    mesh,
    draw(time, bySpeed, focused) {
      values.now.value = time;
      values.bySpeed.value = bySpeed && !flight.ghost;
      values.strength.value = flight.ghost ? 0.75 : focused ? 1 : 0.8;
      values.ahead.value = focused ? 0.18 : 0.08;
    },
    resize(width, height) {
      values.resolution.value.set(width, height);
      values.width.value = (WIDTH * Math.max(height, 500)) / 800;
    },
    theme(theme) {
      speedRamp(theme).forEach((colour, index) => values.ramp.value[index].set(...colour));
      const flat = new Color(flightColour(flight, theme)).getRGB({}, "srgb");
      values.flat_colour.value.set(flat.r, flat.g, flat.b);
    },
  };
}

function ribbon(flight, maxSpeed) {
  const { columns, steps, time } = flight;
  const position = new Float32Array(steps * 6);
  const tangent = new Float32Array(steps * 6);
  const [side, speed, moment] = [0, 0, 0].map(() => new Float32Array(steps * 2));
  for (let i = 0; i < steps; i += 1) {
    const scale = 0.05 / (columns.speed[i] || 1);
    for (const k of [2 * i, 2 * i + 1]) {
      position.set([columns.px[i], columns.py[i], columns.pz[i]], 3 * k);
      tangent.set([columns.vx[i] * scale, columns.vy[i] * scale, columns.vz[i] * scale], 3 * k);
      side[k] = k % 2 ? 1 : -1;
      speed[k] = columns.speed[i] / maxSpeed;
      moment[k] = time[i];
    }
  }
  const index = [];
  for (let i = 0; i < steps - 1; i += 1) index.push(2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 1, 2 * i + 3, 2 * i + 2);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(position, 3));
  geometry.setAttribute("tangent", new BufferAttribute(tangent, 3));
  geometry.setAttribute("side", new BufferAttribute(side, 1));
  geometry.setAttribute("speed", new BufferAttribute(speed, 1));
  geometry.setAttribute("moment", new BufferAttribute(moment, 1));
  geometry.setIndex(index);
  return geometry;
}
