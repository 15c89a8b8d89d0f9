// The 3D view of a pack: a scene is drawn as it is told; all that is computed of it was computed in Python.
import * as THREE from "three";
import { OrbitControls } from "orbit";

const VIRIDIS = ["#440154", "#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"];
const HEAT = ["#f3d9a4", "#f2b46d", "#e98a45", "#d75b30", "#b52d28", "#811526", "#4b0b20"];
const SIZE = { grains: 1, both: 0.3, forces: 0 }; // of a sphere, in its radii
const THINNEST = 0.02, THICKEST = 0.45; // half the width of a force, in R

// Spheres are squares that face the eye, on which each pixel finds its point of the sphere: smooth at any distance,
// and two triangles each, so that tens of thousands stay fluid.
const SPHERE = {
  vertexShader: `
    attribute vec3 centre, tint;
    attribute float radius;
    varying vec3 middle, place, colour;
    varying float wide;
    void main() {
      wide = radius;
      middle = (modelViewMatrix * vec4(centre, 1.0)).xyz;
      colour = tint;
      float away = length(middle);
      vec3 forward = middle / away;
      vec3 right = normalize(cross(forward, vec3(0.0, 1.0, 0.0)));
      float reach = radius * away / sqrt(max(away * away - radius * radius, 1e-6));
      place = middle + reach * (position.x * right + position.y * cross(right, forward));
      gl_Position = projectionMatrix * vec4(place, 1.0);
    }`,
  fragmentShader: `
    uniform mat4 projectionMatrix;
    varying vec3 middle, place, colour;
    varying float wide;
    void main() {
      vec3 ray = normalize(place);
      float along = dot(ray, middle);
      float inside = along * along - dot(middle, middle) + wide * wide;
      if (inside < 0.0) discard;
      vec3 hit = (along - sqrt(inside)) * ray;
      vec3 normal = (hit - middle) / wide;
      vec4 clip = projectionMatrix * vec4(hit, 1.0);
      gl_FragDepth = 0.5 * clip.z / clip.w + 0.5;
      float lit = 0.66 + 0.34 * dot(normal, normalize(vec3(-0.4, 0.7, 0.6)));
      float rim = smoothstep(0.0, 0.3, -dot(normal, ray));
      float shine = 0.12 * pow(max(dot(reflect(ray, normal), normalize(vec3(-0.4, 0.7, 0.6))), 0.0), 12.0);
      gl_FragColor = vec4(colour * lit * mix(0.6, 1.0, rim) + shine, 1.0);
    }`,
};

// Forces are ribbons that face the eye, as wide as the force is large, shaded like rods.
const ROD = {
  vertexShader: `
    attribute vec3 tail, head, tint;
    attribute float width;
    varying vec3 colour;
    varying float across;
    void main() {
      vec3 from = (modelViewMatrix * vec4(tail, 1.0)).xyz, to = (modelViewMatrix * vec4(head, 1.0)).xyz;
      vec3 at = mix(from, to, 0.5 * position.x + 0.5);
      colour = tint;
      across = position.y;
      gl_Position = projectionMatrix * vec4(at + width * position.y * normalize(cross(to - from, at)), 1.0);
    }`,
  fragmentShader: `
    varying vec3 colour;
    varying float across;
    void main() { gl_FragColor = vec4(colour * (1.0 - 0.45 * across * across), 1.0); }`,
};

/** Arrays of a scene from base64 of deflated bytes: a line of JSON that lists them, then their bytes. */
async function unpack(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();
  const end = new Uint8Array(buffer).indexOf(10);
  const scene = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 0, end)));
  let at = 4 * Math.ceil((end + 1) / 4);
  scene.arrays = Object.fromEntries(scene.arrays.map(({ name, kind, length, low, step }) => {
    const raw = new (kind === "u2" ? Uint16Array : Uint32Array)(buffer, at, length);
    at += 4 * Math.ceil(raw.byteLength / 4);
    return [name, step === undefined ? raw : Float32Array.from(raw, (value) => low + step * value)];
  }));
  return scene;
}

function palette(stops) {
  const rgb = stops.map((stop) => [1, 3, 5].map((at) => parseInt(stop.slice(at, at + 2), 16)));
  return (part) => {
    const at = Math.min(Math.max(part, 0), 1) * (rgb.length - 1), low = Math.min(Math.floor(at), rgb.length - 2);
    return rgb[low].map((value, k) => value + (at - low) * (rgb[low + 1][k] - value));
  };
}

/** Squares, one for each instance; `widths` are the numbers of each instanced attribute by name. */
function squares(count, shader, uniforms, widths) {
  const geometry = new THREE.InstancedBufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0], 3));
  geometry.setIndex([0, 1, 2, 0, 2, 3]);
  for (const [name, width] of Object.entries(widths)) {
    const values = name === "tint" ? new Uint8Array(width * count) : new Float32Array(width * count);
    geometry.setAttribute(name, new THREE.InstancedBufferAttribute(values, width, name === "tint"));
  }
  const material = new THREE.ShaderMaterial({ ...shader, uniforms, side: THREE.DoubleSide });
  const mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false;
  return mesh;
}

function settled(mesh, count) {
  mesh.geometry.instanceCount = count;
  for (const attribute of Object.values(mesh.geometry.attributes)) attribute.needsUpdate = true;
}

const written = (value) => (value === 0 ? "0" : value.toPrecision(3).replace(/\.?0+(e|$)/, "$1"));

class View {
  constructor(root, scene) {
    this.root = root;
    this.scene = scene;
    this.grains = scene.grains;
    this.spheres = scene.spheres.length;
    this.find = (name) => root.querySelector(`.${name}`);
    this.canvas = this.find("stage").querySelector("canvas");
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace; // colours are given as they are shown
    this.renderer.setClearColor(0xffffff);
    this.world = new THREE.Scene();
    this.balls = squares(this.grains * this.spheres, SPHERE, { projectionMatrix: { value: null } }, { centre: 3, tint: 3, radius: 1 });
    const most = Math.max(0, ...scene.captions.map((_, frame) => this.links(frame).length));
    this.rods = squares(most, ROD, {}, { tail: 3, head: 3, tint: 3, width: 1 });
    this.box = new THREE.LineSegments(new THREE.EdgesGeometry(new THREE.BoxGeometry(1, 1, 1)), new THREE.LineBasicMaterial({ color: 0x888888 }));
    this.world.add(this.box, this.rods, this.balls);
    this.camera = new THREE.PerspectiveCamera(30, 1, 0.1, 1000);
    this.camera.up.set(0, 0, 1);
    this.balls.material.uniforms.projectionMatrix.value = this.camera.projectionMatrix;
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.addEventListener("change", () => this.draw());
    this.listen();
    this.home();
    new ResizeObserver(() => this.resize()).observe(this.find("stage"));
  }

  links(frame) {
    const { start } = this.scene.arrays;
    return { first: start[frame], length: start[frame + 1] - start[frame] };
  }

  listen() {
    const { scene } = this, at = this.find("frame");
    for (const { label } of scene.quantities) this.find("colour").add(new Option(label));
    at.max = scene.captions.length - 1;
    at.value = at.max; // begins with what came out
    this.find("time").hidden = scene.captions.length < 2;
    for (const name of ["show", "colour", "axis-of-cut", "cut", "frame"]) this.find(name).addEventListener("input", () => this.fill());
    this.find("home").addEventListener("click", () => this.home());
    this.find("save").addEventListener("click", (event) => { event.currentTarget.href = this.canvas.toDataURL("image/png"); });
    this.find("play").addEventListener("click", () => {
      this.playing = this.playing ? clearInterval(this.playing) : setInterval(() => {
        at.value = (Number(at.value) + 1) % scene.captions.length;
        this.fill();
      }, 500);
      this.find("play").textContent = this.playing ? "\u275a\u275a" : "\u25b6";
    });
    this.canvas.addEventListener("pointermove", (event) => this.point(event));
    this.canvas.addEventListener("pointerleave", () => { this.find("tip").hidden = true; });
  }

  home() {
    const { lower, upper } = this.scene.arrays; // of the first frame: no frame moves the eye
    const middle = [0, 1, 2].map((k) => 0.5 * (lower[k] + upper[k]));
    const radius = 0.5 * Math.hypot(...[0, 1, 2].map((k) => upper[k] - lower[k]));
    const { clientWidth, clientHeight } = this.find("stage"), narrow = Math.min(1, clientWidth / clientHeight || 1);
    this.controls.target.set(...middle);
    this.camera.position.set(...middle).addScaledVector(new THREE.Vector3(0.72, 0.6, 0.42).normalize(), 3.9 * radius / narrow);
    this.camera.near = 0.05 * radius;
    this.camera.far = 60 * radius;
    this.camera.updateProjectionMatrix();
    this.fill();
    this.controls.update();
  }

  /** Everything of the chosen frame into the buffers. */
  fill() {
    const { scene, grains } = this, { position, quaternion, sizes, lower, upper, ends, force } = scene.arrays;
    const frame = Number(this.find("frame").value), show = this.find("show").value;
    const quantity = scene.quantities[this.find("colour").selectedIndex];
    const axis = this.find("axis-of-cut").selectedIndex, cut = Number(this.find("cut").value);
    const low = [...lower.subarray(3 * frame, 3 * frame + 3)], high = [...upper.subarray(3 * frame, 3 * frame + 3)];
    const limit = cut < 1 ? low[axis] + cut * (high[axis] - low[axis]) : Infinity;
    const places = position.subarray(3 * grains * frame, 3 * grains * (frame + 1));
    const kept = (grain) => places[3 * grain + axis] <= limit;
    this.values = scene.arrays[quantity.name].subarray(grains * frame, grains * (frame + 1));

    const { centre, tint, radius } = this.balls.geometry.attributes, colours = palette(VIRIDIS);
    this.shown = [];
    for (let grain = 0; grain < grains && SIZE[show]; grain++) {
      if (!kept(grain)) continue;
      const [w, x, y, z] = quaternion.subarray(4 * (grains * frame + grain));
      const colour = colours(this.values[grain] / quantity.top);
      for (const sphere of scene.spheres) {
        const at = 3 * this.shown.length, [a, b, c, wide] = sphere.map((length) => sizes[grain] * length);
        const p = 2 * (y * c - z * b), q = 2 * (z * a - x * c), r = 2 * (x * b - y * a); // 2 v x offset
        centre.array[at] = places[3 * grain] + a + w * p + y * r - z * q;
        centre.array[at + 1] = places[3 * grain + 1] + b + w * q + z * p - x * r;
        centre.array[at + 2] = places[3 * grain + 2] + c + w * r + x * q - y * p;
        tint.array.set(colour, at);
        radius.array[this.shown.length] = SIZE[show] * wide;
        this.shown.push(grain);
      }
    }
    this.balls.visible = SIZE[show] > 0;
    settled(this.balls, this.shown.length);

    const rods = this.rods.geometry.attributes, heat = palette(HEAT), { first, length } = this.links(frame);
    let count = 0;
    for (let link = first; link < first + length && show !== "grains"; link++) {
      const one = ends[2 * link], other = ends[2 * link + 1];
      if (!kept(one) || !kept(other)) continue;
      const part = Math.min(force[link] / scene.force.top, 1);
      rods.tail.array.set(places.subarray(3 * one, 3 * one + 3), 3 * count);
      rods.head.array.set(places.subarray(3 * other, 3 * other + 3), 3 * count);
      rods.tint.array.set(heat(part), 3 * count);
      rods.width.array[count++] = THINNEST + (THICKEST - THINNEST) * part;
    }
    settled(this.rods, count);

    this.box.scale.set(...high.map((value, k) => value - low[k]));
    this.box.position.set(...high.map((value, k) => 0.5 * (value + low[k])));
    this.corners = { low, high };
    this.find("when").textContent = scene.captions[frame];
    this.bar("grains", quantity, VIRIDIS, show !== "forces");
    this.bar("forces", scene.force, HEAT, show !== "grains");
    this.draw();
  }

  bar(name, { label, unit, top, most }, stops, visible) {
    const bar = this.root.querySelector(`.bar.${name}`), [from, to] = bar.querySelectorAll("span");
    bar.hidden = !visible;
    bar.querySelector("b").textContent = unit ? `${label} (${unit})` : label;
    bar.querySelector("i").style.background = `linear-gradient(to right, ${stops.join(",")})`;
    from.textContent = "0";
    to.textContent = (most > top ? "\u2265 " : "") + written(top);
  }

  resize() {
    const { clientWidth, clientHeight } = this.find("stage");
    if (!clientWidth) return;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  draw() {
    this.renderer.render(this.world, this.camera);
    const { low, high } = this.corners, { clientWidth, clientHeight } = this.canvas;
    const edges = [[null, high[1], low[2]], [high[0], null, low[2]], [high[0], low[1], null]];
    const pixel = (place) => {
      const at = new THREE.Vector3(...place.map((value, k) => value ?? 0.5 * (low[k] + high[k]))).project(this.camera);
      return new THREE.Vector2((0.5 + 0.5 * at.x) * clientWidth, (0.5 - 0.5 * at.y) * clientHeight);
    };
    const middle = pixel([null, null, null]);
    this.root.querySelectorAll(".axis").forEach((label, axis) => {
      const edge = pixel(edges[axis]), at = edge.clone().sub(middle).setLength(38).add(edge); // outside the box
      label.textContent = `${"xyz"[axis]}: ${(high[axis] - low[axis]).toFixed(2)} R`;
      const x = Math.min(Math.max(at.x, 40), clientWidth - 40); // half a label, that none is cut
      label.style.transform = `translate(-50%, -50%) translate(${x}px, ${at.y}px)`;
    });
  }

  /** Say the numbers of the grain under the pointer. */
  point(event) {
    const tip = this.find("tip"), { centre, radius } = this.balls.geometry.attributes;
    tip.hidden = true;
    if (event.buttons || !this.balls.visible) return;
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    const x = event.clientX - left, y = event.clientY - top;
    const eye = this.camera.position, to = new THREE.Vector3((2 * x) / width - 1, 1 - (2 * y) / height, 0.5).unproject(this.camera).sub(eye).normalize();
    let nearest = Infinity, found = -1;
    for (let ball = 0; ball < this.shown.length; ball++) {
      const a = centre.array[3 * ball] - eye.x, b = centre.array[3 * ball + 1] - eye.y, c = centre.array[3 * ball + 2] - eye.z;
      const along = a * to.x + b * to.y + c * to.z;
      const inside = along * along - (a * a + b * b + c * c) + radius.array[ball] ** 2;
      if (inside < 0 || along - Math.sqrt(inside) > nearest) continue;
      nearest = along - Math.sqrt(inside);
      found = this.shown[ball];
    }
    if (found < 0) return;
    const at = this.grains * Number(this.find("frame").value) + found;
    const lines = this.scene.quantities.map(({ name, label, unit }) => `${label}: ${written(this.scene.arrays[name][at])} ${unit}`);
    tip.textContent = [`grain ${found}`, ...lines].join("\n");
    tip.style.transform = `translate(${x + 14}px, ${y + 10}px)`;
    tip.hidden = false;
  }
}

async function start(root) {
  try {
    root.view = new View(root, await unpack(document.getElementById(root.dataset.scene).textContent));
  } catch (error) {
    root.querySelector(".stage").textContent = `This browser cannot draw the pack in 3D (${error.message}).`;
  }
}

// Each view begins when it is scrolled to: a browser has few WebGL contexts.
const seen = new IntersectionObserver((entries) => entries.filter((entry) => entry.isIntersecting).forEach(({ target }) => {
  seen.unobserve(target);
  start(target);
}), { rootMargin: "200px" });
document.querySelectorAll(".view").forEach((root) => seen.observe(root));
