/** Draws the bodies of a MuJoCo model with three.js: what is visible of a body is one mesh with a colour per vertex. */

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { mergeGeometries, mergeVertices, toCreasedNormals } from "three/addons/utils/BufferGeometryUtils.js";

const [SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH] = [2, 3, 4, 5, 6, 7]; // mjtGeom
const HAZE = new THREE.Color(0xdfe6ee); // the sky, and the floor far away
const SHARP = 0.7; // faces that meet at a larger angle [rad] have an edge
const DRAWN_GROUPS = 3; // MuJoCo hides the others
const LATE = 1 / 55; // frames that take longer [s] on average get fewer pixels
const STEP = 0.8; // of pixels per unit of length
const [PATIENCE, LONGEST] = [4, 64]; // calls of adapt() on time before there are more pixels, at first and at most
const TURNED = new THREE.Matrix4().makeRotationX(Math.PI / 2); // three's cylinders are along y, MuJoCo's along z

export class Scene {
  /** Takes an element to draw into and a model of MuJoCo, whose z axis points up. */
  constructor(canvas, model) {
    THREE.Object3D.DEFAULT_UP.set(0, 0, 1);
    const hasGpu = !isSoftware();
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: hasGpu });
    this.ratio = this.finest = Math.min(window.devicePixelRatio, 2);
    this.coarsest = Math.min(this.finest, hasGpu ? 1 : 0.3);
    [this.patience, this.onTime] = [PATIENCE, 0];
    if (!hasGpu) canvas.style.imageRendering = "pixelated"; // to smooth a large picture takes half of a frame's time
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.05, 60);
    const size = model.stat.extent; // of the robot [m]
    this.height = model.stat.center[2];
    this.camera.position.set(1.3, -1.8, 0.9).multiplyScalar(size);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enablePan = false;
    this.controls.maxPolarAngle = 1.5;
    this.scene = new THREE.Scene();
    this.scene.background = HAZE;
    this.sun = new THREE.DirectionalLight(0xffffff, 2.2);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8a8f99, 1.6), this.sun, this.sun.target);
    this.floor = floor(0.7 * size);
    const material = hasGpu ? new THREE.MeshPhongMaterial({ vertexColors: true, shininess: 40 }) : mattMaterial();
    const detail = (hasGpu ? 1e-4 : 1e-2) * size; // without a GPU, a frame's time grows with the number of triangles
    this.bodies = Array.from({ length: model.nbody }, (_, body) => bodyMesh(model, body, material, detail));
    this.scene.add(this.floor, ...this.bodies.filter(Boolean));
  }

  /** Moves the bodies to where they are in MuJoCo's data; the camera goes along with the trunk. */
  update(data, trunk) {
    const { xpos, xquat } = data;
    this.bodies.forEach((mesh, i) => {
      mesh?.position.fromArray(xpos, 3 * i);
      mesh?.quaternion.set(xquat[4 * i + 1], xquat[4 * i + 2], xquat[4 * i + 3], xquat[4 * i]);
    });
    const at = new THREE.Vector3().fromArray(xpos, 3 * trunk);
    const moved = at.clone().sub(this.controls.target);
    moved.z = this.height - this.controls.target.z;
    this.controls.target.add(moved);
    this.camera.position.add(moved);
    this.sun.position.copy(at).add(new THREE.Vector3(2, -3, 6));
    this.sun.target.position.copy(at);
    this.floor.position.set(at.x, at.y, 0);
  }

  /** Draws with fewer pixels from now on if frames take long [s], and with more once they have been on time for a while,
   * which is twice as long after each time that there were too many. */
  adapt(frameTime) {
    this.onTime = frameTime > LATE ? 0 : this.onTime + 1;
    if (!this.onTime && this.ratio > this.coarsest) {
      this.ratio = Math.max(STEP * this.ratio, this.coarsest);
      this.patience = Math.min(2 * this.patience, LONGEST);
    } else if (this.onTime > this.patience) {
      this.ratio = Math.min(this.ratio / STEP, this.finest);
      this.onTime = 0;
    }
  }

  /** Draws a frame. */
  render() {
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement;
    const size = this.renderer.getSize(new THREE.Vector2());
    if (size.x !== width || size.y !== height || this.renderer.getPixelRatio() !== this.ratio) {
      this.renderer.setPixelRatio(this.ratio);
      this.renderer.setSize(width, height, false);
      this.camera.aspect = width / height;
      this.camera.updateProjectionMatrix();
    }
    this.controls.update();
    this.renderer.render(this.scene, this.camera);
  }
}

/** Returns whether the browser draws without a GPU. */
function isSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  return !info || /swiftshader|llvmpipe|software/i.test(gl.getParameter(info.UNMASKED_RENDERER_WEBGL));
}

/** Returns the mesh of a body's visible geoms with details down to some size [m], or null if it has none. */
function bodyMesh(model, body, material, detail) {
  const parts = [];
  for (let geom = 0; geom < model.ngeom; geom++) {
    if (model.geom_bodyid[geom] !== body || model.geom_group[geom] >= DRAWN_GROUPS) continue;
    const shape = geometry(model, geom);
    if (shape) parts.push(placed(shaded(shape, detail), model, geom));
  }
  if (!parts.length) return null;
  return new THREE.Mesh(mergeVertices(mergeGeometries(parts)), material);
}

/** Returns a geom's surface; null for a plane and for kinds without one here. */
function geometry(model, geom) {
  const [a, b, c] = model.geom_size.slice(3 * geom, 3 * geom + 3);
  const make = {
    [SPHERE]: () => new THREE.SphereGeometry(a, 20, 14),
    [CAPSULE]: () => new THREE.CapsuleGeometry(a, 2 * b, 8, 16).applyMatrix4(TURNED),
    [ELLIPSOID]: () => new THREE.SphereGeometry(1, 24, 16).scale(a, b, c),
    [CYLINDER]: () => new THREE.CylinderGeometry(a, a, 2 * b, 24).applyMatrix4(TURNED),
    [BOX]: () => new THREE.BoxGeometry(2 * a, 2 * b, 2 * c),
    [MESH]: () => meshGeometry(model, model.geom_dataid[geom]),
  }[model.geom_type[geom]];
  return make ? make() : null;
}

/** Returns a mesh of the model. */
function meshGeometry(model, mesh) {
  const [vertex, face] = [model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]];
  const vertices = model.mesh_vert.slice(3 * vertex, 3 * (vertex + model.mesh_vertnum[mesh]));
  const corners = model.mesh_face.slice(3 * face, 3 * (face + model.mesh_facenum[mesh]));
  const shape = new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(vertices, 3));
  return shape.setIndex(Array.from(corners));
}

/** Returns a shape with normals, whose corners closer than some distance [m] are one; thin shapes keep finer ones. */
function shaded(shape, detail) {
  ["normal", "uv"].forEach((name) => shape.deleteAttribute(name));
  shape.computeBoundingBox();
  const thickness = Math.min(...shape.boundingBox.getSize(new THREE.Vector3()));
  const merged = mergeVertices(shape, Math.min(detail, thickness / 3));
  const { array } = merged.index;
  const corners = [];
  for (let i = 0; i < array.length; i += 3) {
    const [a, b, c] = array.slice(i, i + 3);
    if (a !== b && b !== c && c !== a) corners.push(a, b, c);
  }
  return toCreasedNormals(merged.setIndex(corners), SHARP);
}

/** Returns a geom's shape in the frame of its body, in the geom's colour. */
function placed(shape, model, geom) {
  const [w, x, y, z] = model.geom_quat.slice(4 * geom, 4 * geom + 4);
  const pose = new THREE.Matrix4().makeRotationFromQuaternion(new THREE.Quaternion(x, y, z, w));
  shape.applyMatrix4(pose.setPosition(...model.geom_pos.slice(3 * geom, 3 * geom + 3)));
  const material = model.geom_matid[geom];
  const rgba = material < 0 ? model.geom_rgba : model.mat_rgba;
  const at = 4 * (material < 0 ? geom : material);
  const colour = new THREE.Color().setRGB(rgba[at], rgba[at + 1], rgba[at + 2], THREE.SRGBColorSpace);
  const count = shape.attributes.position.count;
  const colours = Float32Array.from({ length: 3 * count }, (_, i) => [colour.r, colour.g, colour.b][i % 3]);
  return shape.setAttribute("color", new THREE.BufferAttribute(colours, 3));
}

/** Returns a matt material in the vertices' colours, whose light is computed at vertices only: cheap without a GPU. */
function mattMaterial() {
  return new THREE.ShaderMaterial({
    vertexColors: true,
    vertexShader: `
      varying vec3 shade;
      void main() {
        vec3 up = normalize(mat3(modelMatrix) * normal);
        float light = 0.55 + 0.2 * up.z + 0.6 * max(dot(up, normalize(vec3(2.0, -3.0, 6.0))), 0.0);
        shade = pow(min(color * light, 1.0), vec3(1.0 / 2.2));
        gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
      }`,
    fragmentShader: "varying vec3 shade; void main() { gl_FragColor = vec4(shade, 1.0); }",
  });
}

/** Returns a floor of squares of 1 m that stay in place, with a dark spot of some radius [m] in its middle for a shadow.
 * All is computed per pixel, for without a GPU textures and shadow maps cost most of a frame. */
function floor(radius) {
  const material = new THREE.ShaderMaterial({
    uniforms: { spot: { value: 1 / radius ** 2 }, haze: { value: HAZE.clone().convertLinearToSRGB() } },
    vertexShader: `
      varying vec2 place, offset;
      void main() {
        vec4 world = modelMatrix * vec4(position, 1.0);
        place = 0.5 * world.xy;
        offset = position.xy;
        gl_Position = projectionMatrix * viewMatrix * world;
      }`,
    fragmentShader: `
      uniform float spot;
      uniform vec3 haze;
      varying vec2 place, offset;
      void main() {
        vec2 pixel = 0.5 * fwidth(place) + 1e-4; // half of one; squares are averaged over it, else far ones flicker
        vec2 edges = (abs(fract(place - pixel) - 0.5) - abs(fract(place + pixel) - 0.5)) / pixel;
        vec3 colour = mix(vec3(0.60, 0.63, 0.68), vec3(0.67, 0.70, 0.74), 0.5 - 0.125 * edges.x * edges.y);
        float dark = 1.0 - min(spot * dot(offset, offset), 1.0);
        colour *= 1.0 - 0.45 * dark * dark;
        gl_FragColor = vec4(mix(colour, haze, clamp(0.05 / gl_FragCoord.w - 0.3, 0.0, 1.0)), 1.0);
      }`,
  });
  return new THREE.Mesh(new THREE.PlaneGeometry(60, 60), material);
}
