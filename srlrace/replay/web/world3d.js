// What does not move: floor, bounds, obstacles.

import {
  BoxGeometry, BufferAttribute, BufferGeometry, Color, CylinderGeometry, InstancedMesh, LineBasicMaterial,
  LineSegments, Matrix4, Mesh, MeshBasicMaterial, MeshLambertMaterial, PlaneGeometry, ShaderMaterial, SphereGeometry,
  Vector3,
} from "./three/three.min.js";
import { SCENE } from "./colours.js";

const MARGIN = 30; // m of floor around the bounds, fading into the sky

const FLOOR_VERTEX = `
varying vec3 place;
void main() { place = position; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`;

// Lines of one pixel at any distance, faded out where they would crowd.
const FLOOR_FRAGMENT = `
uniform vec3 floorColour; uniform vec3 lineColour; uniform vec3 sky; uniform vec4 bounds; varying vec3 place;
float lines(float pitch) {
  vec2 at = place.xy / pitch; vec2 width = fwidth(at);
  vec2 near = abs(fract(at - 0.5) - 0.5) / max(width, 1e-6);
  return (1.0 - min(min(near.x, near.y), 1.0)) * (1.0 - smoothstep(0.15, 0.5, max(width.x, width.y)));
}
void main() {
  vec2 outside = max(max(bounds.xy - place.xy, place.xy - bounds.zw), 0.0);
  float fade = smoothstep(0.0, ${MARGIN.toFixed(1)}, length(outside));
  float ink = max(0.4 * lines(1.0), lines(5.0)) * (1.0 - smoothstep(0.0, 6.0, length(outside)));
  gl_FragColor = vec4(mix(mix(floorColour, lineColour, ink), sky, fade), 1.0);
}`;

export function createFloor(course) {
  const [low, high] = [course.low, course.high];
  const uniforms = {
    floorColour: { value: new Vector3() }, lineColour: { value: new Vector3() }, sky: { value: new Vector3() },
    bounds: { value: [low[0], low[1], high[0], high[1]] },
  };
  const geometry = new PlaneGeometry(high[0] - low[0] + 2 * MARGIN, high[1] - low[1] + 2 * MARGIN);
  geometry.translate((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]);
  const floor = new Mesh(geometry, new ShaderMaterial({ uniforms, vertexShader: FLOOR_VERTEX, fragmentShader: FLOOR_FRAGMENT }));
  const edges = new LineSegments(boxEdges(low, high), new LineBasicMaterial({ transparent: true, opacity: 0.55 }));
  return {
    objects: [floor, edges],
    theme(theme) {
      for (const [name, key] of [["floorColour", "floor"], ["lineColour", "line"], ["sky", "sky"]]) {
        const colour = new Color(SCENE[theme][key]).getRGB({}, "srgb");
        uniforms[name].value.set(colour.r, colour.g, colour.b);
      }
      edges.material.color = new Color(SCENE[theme].bounds);
    },
  };
}

function boxEdges(low, high) {
  const corner = (k) => [0, 1, 2].map((axis) => (k & (1 << axis) ? high : low)[axis]);
  const points = [];
  for (let a = 0; a < 8; a += 1) {
    for (const bit of [1, 2, 4]) if (!(a & bit)) points.push(...corner(a), ...corner(a | bit));
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(points), 3));
  return geometry;
}

/** Obstacles as drawn, and around them the surface that the drone's centre must not cross. */
export function createObstacles(scene, course) {
  const focus = { depth: { value: 0 }, centre: { value: new Vector3() } };
  const solid = seeThrough(new MeshLambertMaterial(), focus);
  const shell = new MeshBasicMaterial({ transparent: true, opacity: 0.2, depthWrite: false });
  const nearest = new MeshBasicMaterial({ colorWrite: false }); // of overlapping spheres only the front shows
  shell.onBeforeCompile = (shader) => { // no veil over the camera that is inside one
    shader.fragmentShader = shader.fragmentShader.replace("#include <opaque_fragment>",
      "diffuseColor.a *= smoothstep(1.0, 4.0, 1.0 / gl_FragCoord.w);\n#include <opaque_fragment>");
  };
  const solids = shapes(scene).map(([geometry, matrices]) => instances(geometry, solid, matrices));
  const shells = collisionShapes(scene, course.keepOut).flatMap(([geometry, matrices]) =>
    [nearest, shell].map((material, order) => {
      const mesh = instances(geometry, material, matrices);
      mesh.renderOrder = 5 + order; // after the trails, which would vanish behind their depth
      return mesh;
    }));
  return {
    objects: [...solids, ...shells],
    draw(drawn, withShells, depth, centre) {
      for (const mesh of solids) mesh.visible = drawn;
      for (const mesh of shells) mesh.visible = drawn && withShells;
      focus.depth.value = depth;
      focus.centre.value.copy(centre);
    },
    theme(theme) {
      solid.color = new Color(SCENE[theme].obstacle);
      shell.color = new Color(SCENE[theme].shell);
    },
  };
}

/** Pairs of a unit geometry and the matrices that place it. */
function shapes({ sphere, cylinder, box }) {
  return [
    [new SphereGeometry(1, 28, 18), sphere.map(([x, y, z, r]) => placed([x, y, z], [r, r, r]))],
    [new CylinderGeometry(1, 1, 1, 24).rotateX(Math.PI / 2), cylinder.map(([x, y, z, r, h]) => placed([x, y, z], [r, r, h]))],
    [new BoxGeometry(1, 1, 1), box.map(([x, y, z, edge]) => placed([x, y, z], [edge, edge, edge]))],
  ];
}

/** A stack of spheres is drawn as the capsule around it, a block of them as its outer spheres. */
function collisionShapes({ sphere, cylinder, box }, margin) {
  const balls = sphere.map(([x, y, z, r]) => placed([x, y, z], Array(3).fill(r + margin)));
  const tubes = [];
  for (const [x, y, , r, , low, high] of cylinder) {
    const wide = r + margin;
    tubes.push(placed([x, y, (low + high) / 2], [wide, wide, Math.max(high - low, 1e-3)]));
    for (const z of [low, high]) balls.push(placed([x, y, z], [wide, wide, wide]));
  }
  for (const [x, y, z, edge, count, r] of box) {
    const at = (k) => edge * ((k + 0.5) / count - 0.5);
    for (const [i, j, k] of outer(count)) balls.push(placed([x + at(i), y + at(j), z + at(k)], Array(3).fill(r + margin)));
  }
  const tube = new CylinderGeometry(1, 1, 1, 24, 1, true).rotateX(Math.PI / 2);
  return [[new SphereGeometry(1, 20, 12), balls], [tube, tubes]];
}

function outer(count) {
  const found = [];
  for (let i = 0; i < count; i += 1) {
    for (let j = 0; j < count; j += 1) {
      for (let k = 0; k < count; k += 1) if ([i, j, k].some((n) => n === 0 || n === count - 1)) found.push([i, j, k]);
    }
  }
  return found;
}

function placed([x, y, z], [sx, sy, sz]) {
  return new Matrix4().makeScale(sx, sy, sz).setPosition(x, y, z);
}

function instances(geometry, material, matrices) {
  const mesh = new InstancedMesh(geometry, material, Math.max(matrices.length, 1));
  mesh.count = matrices.length;
  matrices.forEach((matrix, index) => mesh.setMatrixAt(index, matrix));
  mesh.frustumCulled = false;
  return mesh;
}

/** Let obstacles between the camera and the drone dissolve, so that they never hide it. */
function seeThrough(material, focus) {
  material.onBeforeCompile = (shader) => {
    shader.uniforms.focusDepth = focus.depth;
    shader.uniforms.focusCentre = focus.centre;
    shader.fragmentShader = shader.fragmentShader
      .replace("void main() {", `uniform float focusDepth; uniform vec3 focusCentre;
        void main() {
          if (focusDepth > 0.0) {
            float depth = length(vViewPosition);
            vec3 line = normalize(focusCentre);
            vec3 here = -vViewPosition;
            float off = length(here - line * dot(here, line));
            float keep = max(smoothstep(0.25, 0.9, off), smoothstep(focusDepth - 0.4, focusDepth + 0.2, depth));
            keep = min(keep, smoothstep(0.2, 0.8, depth));
            float grain = fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(0.06711056, 0.00583715))));
            if (grain > 0.12 + keep) discard;
          }`);
  };
  return material;
}
