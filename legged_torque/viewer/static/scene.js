/** Draws the bodies of a MuJoCo model with three.js: what is visible of a body is one mesh with a colour per vertex. */

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { mergeGeometries } from "three/addons/utils/BufferGeometryUtils.js";

const [SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH] = [2, 3, 4, 5, 6, 7]; // mjtGeom
const DRAWN_GROUPS = 3; // MuJoCo hides the others
const [SLOW, COARSEST] = [1 / 40, 0.3]; // frames that take longer [s] get fewer pixels, down to this ratio
const TURNED = new THREE.Matrix4().makeRotationX(Math.PI / 2); // three's cylinders are along y, MuJoCo's along z

export class Scene {
  /** Takes an element to draw into and a model of MuJoCo, whose z axis points up. */
  constructor(canvas, model) {
    THREE.Object3D.DEFAULT_UP.set(0, 0, 1);
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !isSoftware() });
    this.ratio = Math.min(window.devicePixelRatio, 2);
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.05, 60);
    const size = model.stat.extent; // of the robot [m]
    this.height = model.stat.center[2];
    this.camera.position.set(1.3, -1.8, 0.9).multiplyScalar(size);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enablePan = false;
    this.controls.maxPolarAngle = 1.5;
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(0xdfe6ee);
    this.scene.fog = new THREE.Fog(0xdfe6ee, 6, 25);
    this.sun = new THREE.DirectionalLight(0xffffff, 2.2);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8a8f99, 1.6), this.sun, this.sun.target);
    this.floor = floor();
    this.bodies = Array.from({ length: model.nbody }, (_, body) => bodyMesh(model, body));
    this.scene.add(this.floor, ...this.bodies.filter(Boolean));
    this.shadow = blob(1.4 * size);
    this.scene.add(this.shadow);
  }

  /** Moves the bodies to where they are in MuJoCo's data; the camera goes along with the trunk. */
  update(data, trunk) {
    const { xpos, xquat } = data;
    this.bodies.forEach((mesh, i) => {
      mesh?.position.fromArray(xpos, 3 * i);
      mesh?.quaternion.set(xquat[4 * i + 1], xquat[4 * i + 2], xquat[4 * i + 3], xquat[4 * i]);
    });
    const at = new THREE.Vector3().fromArray(xpos, 3 * trunk);
    this.shadow.position.set(at.x, at.y, 0.002);
    const moved = at.clone().sub(this.controls.target);
    moved.z = this.height - this.controls.target.z;
    this.controls.target.add(moved);
    this.camera.position.add(moved);
    this.sun.position.copy(at).add(new THREE.Vector3(2, -3, 6));
    this.sun.target.position.copy(at);
    this.floor.position.set(2 * Math.round(at.x / 2), 2 * Math.round(at.y / 2), 0); // its pattern repeats every 2 m
  }

  /** Draws with fewer pixels from now on if frames take long [s]. */
  adapt(frameTime) {
    if (frameTime > SLOW) this.ratio = Math.max(0.8 * this.ratio, COARSEST);
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

/** Returns the mesh of a body's visible geoms, or null if it has none. */
function bodyMesh(model, body) {
  const parts = [];
  for (let geom = 0; geom < model.ngeom; geom++) {
    if (model.geom_bodyid[geom] !== body || model.geom_group[geom] >= DRAWN_GROUPS) continue;
    const shape = geometry(model, geom);
    if (shape) parts.push(shape);
  }
  if (!parts.length) return null;
  const material = new THREE.MeshPhongMaterial({ vertexColors: true, shininess: 40 });
  return new THREE.Mesh(mergeGeometries(parts), material);
}

/** Returns a geom's surface in the frame of its body, in its colour; null for a plane and for kinds without one here. */
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
  if (!make) return null;
  const made = make();
  const shape = made.index ? made.toNonIndexed() : made;
  shape.deleteAttribute("uv");
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

/** Returns the triangles of a mesh of the model, with its normals. */
function meshGeometry(model, mesh) {
  const [vertex, face] = [model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]];
  const corners = model.mesh_face.slice(3 * face, 3 * (face + model.mesh_facenum[mesh]));
  const vertices = new Float32Array(3 * corners.length);
  corners.forEach((corner, i) => vertices.set(model.mesh_vert.slice(3 * (vertex + corner), 3 * (vertex + corner) + 3), 3 * i));
  const shape = new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(vertices, 3));
  shape.computeVertexNormals();
  return shape;
}

/** Returns a checkered floor. */
function floor() {
  const canvas = Object.assign(document.createElement("canvas"), { width: 2, height: 2 });
  const context = canvas.getContext("2d");
  context.fillStyle = "#aab2bd";
  context.fillRect(0, 0, 2, 2);
  context.fillStyle = "#98a1ad";
  context.fillRect(0, 0, 1, 1);
  context.fillRect(1, 1, 1, 1);
  const texture = new THREE.CanvasTexture(canvas);
  texture.magFilter = THREE.NearestFilter;
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.repeat.set(30, 30);
  texture.colorSpace = THREE.SRGBColorSpace;
  return new THREE.Mesh(new THREE.PlaneGeometry(60, 60), new THREE.MeshBasicMaterial({ map: texture }));
}

/** Returns a soft dark spot of some width [m], in place of shadows, which slow machines draw slowly. */
function blob(size) {
  const canvas = Object.assign(document.createElement("canvas"), { width: 64, height: 64 });
  const context = canvas.getContext("2d");
  const gradient = context.createRadialGradient(32, 32, 4, 32, 32, 32);
  gradient.addColorStop(0, "rgba(0,0,0,0.45)");
  gradient.addColorStop(1, "rgba(0,0,0,0)");
  context.fillStyle = gradient;
  context.fillRect(0, 0, 64, 64);
  const map = new THREE.CanvasTexture(canvas);
  return new THREE.Mesh(
    new THREE.PlaneGeometry(size, size),
    new THREE.MeshBasicMaterial({ map, transparent: true, depthWrite: false }),
  );
}
