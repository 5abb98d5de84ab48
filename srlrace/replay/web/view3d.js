// The flights in space, by WebGL.

import { Color, DirectionalLight, Fog, HemisphereLight, Scene, Vector3, WebGLRenderer } from "./three/three.min.js";
import { createCamera } from "./camera.js";
import { SCENE } from "./colours.js";
import { createDrone } from "./drone3d.js";
import { passedAt, sample } from "./flight.js";
import { createGates } from "./gates3d.js";
import { createTrail } from "./trail3d.js";
import { createFloor, createObstacles } from "./world3d.js";

const HAZE = { near: 35, far: 130 }; // m
const CLEAR = { near: 5000, far: 9000 };
const SLOW = 45; // ms a frame: then fewer pixels are drawn
const LEAST_PIXELS = 0.5;
const MOST_PIXELS = 2; // device pixels per CSS pixel that are drawn at most: phones have 3, nobody sees it

/** Returns null where there is no WebGL. */
export function createView3D(canvas, data) {
  const renderer = createRenderer(canvas);
  if (renderer === null) return null;
  const scene = new Scene();
  const sun = new DirectionalLight(0xffffff, 1.9);
  sun.position.set(-0.45, -0.6, 1);
  const ambient = new HemisphereLight(0xffffff, 0x8895a5, 1.5);
  scene.add(sun, ambient);
  scene.fog = new Fog(0xffffff, 35, 130);
  const rig = createCamera(data.course, data.flights);
  const floor = createFloor(data.course);
  const obstacles = data.scenes.map((part) => createObstacles(part, data.course));
  const gates = createGates(data.course);
  const trails = data.flights.map((flight) => createTrail(flight, data.maxSpeed));
  const drones = data.flights.map((flight) => createDrone(flight, data.course));
  for (const part of [floor, gates, ...obstacles, ...drones]) scene.add(...part.objects);
  for (const trail of trails) scene.add(trail.mesh);

  const size = { width: 1, height: 1, ratio: 1, last: null, mean: 16 };

  /** Draw fewer pixels where a frame takes long, as without a graphics card. */
  function adapt(playing) {
    const now = performance.now();
    if (playing && size.last !== null) size.mean += 0.1 * (Math.min(now - size.last, 400) - size.mean);
    size.last = playing ? now : null;
    if (size.mean < SLOW || size.ratio <= LEAST_PIXELS) return;
    Object.assign(size, { ratio: Math.max(size.ratio * 0.75, LEAST_PIXELS), mean: 16 });
    fit();
  }

  function fit() {
    renderer.setPixelRatio(size.ratio);
    renderer.setSize(size.width, size.height, false);
  }

  function draw(state) {
    const focus = data.flights[state.focus];
    const depth = rig.look(state, focus);
    rig.camera.updateMatrixWorld();
    Object.assign(scene.fog, state.camera === "top" ? CLEAR : HAZE);
    adapt(state.playing);
    const centre = new Vector3(...sample(focus, state.time).position).applyMatrix4(rig.camera.matrixWorldInverse);
    obstacles.forEach((part, index) => part.draw(index === focus.scene, state.shells, depth, centre));
    gates.draw(focus, passedAt(focus, state.time), rig.tangent());
    data.flights.forEach((flight, index) => {
      const drawn = state.visible.has(index);
      trails[index].mesh.visible = drawn;
      trails[index].draw(state.time, state.bySpeed, index === state.focus);
      drones[index].draw(sample(flight, state.time), rig.camera.position, rig.tangent(), drawn);
    });
    renderer.render(scene, rig.camera);
  }

  return {
    kind: "3D",
    draw,
    drag: (dx, dy, state, pan) => rig.drag(dx, dy, state.camera, pan),
    zoom: (factor) => rig.zoom(factor),
    reset: () => rig.reset(),
    resize(width, height, free) {
      Object.assign(size, { width, height, ratio: Math.min(window.devicePixelRatio, MOST_PIXELS) });
      fit();
      rig.resize(width, height, free);
      trails.forEach((trail) => trail.resize(width, height));
    },
    theme(theme) {
      renderer.setClearColor(new Color(SCENE[theme].sky));
      scene.fog.color = new Color(SCENE[theme].sky);
      for (const part of [floor, gates, ...obstacles, ...trails, ...drones]) part.theme(theme);
    },
  };
}

function createRenderer(canvas) {
  try {
    const context = canvas.getContext("webgl2", { antialias: true, alpha: false, powerPreference: "high-performance" });
    return context && new WebGLRenderer({ canvas, context });
  } catch {
    return null;
  }
}
