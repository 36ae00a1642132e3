// Draws a scene's fixed cameras in WebGL as MuJoCo's renderer does: light at each corner, no shadows.
import { model as built } from "./constants.js";
import * as meshes from "./meshes.js";

// as finely as MuJoCo draws for people, and for policies
const FINE = { slices: 28, stacks: 16, quads: 4, antialias: true };
export const FAST = { slices: 14, stacks: 8, quads: 2, antialias: false };
const SHOWN_GROUPS = 3; // geoms of groups 0 to 2 are drawn
const DEFAULT_RGBA = [0.5, 0.5, 0.5, 1]; // a geom's own colour, unless it is this one, is before its material's
const NO_MATERIAL = { emission: 0, specular: 0.5, shininess: 0.5, texture: -1 };
const OPAQUE = 0.995;
const PARTS = { PLANE: "plane", SPHERE: "sphere", ELLIPSOID: "sphere", CYLINDER: "cylinder", BOX: "box" };

const VERTEX_SHADER = `#version 300 es
uniform mat4 clipFromWorld;
uniform mat3 turn;
uniform vec3 position, size, eye, sun, forward, headAmbient, headDiffuse, sunDiffuse, sunSpecular;
uniform vec4 rgba;
uniform float emission, specular, shininess;
uniform vec2 textureScale;
layout(location = 0) in vec3 corner;
layout(location = 1) in vec3 normal;
out vec4 color;
out vec2 place;
void main() {
  vec3 point = position + turn * (size * corner);
  vec3 n = normalize(turn * (normal / size));
  vec3 toEye = normalize(eye - point);
  float lit = dot(n, -sun);
  float shine = lit > 0.0 ? pow(max(dot(n, normalize(toEye - sun)), 0.0), shininess * 128.0) : 0.0;
  vec3 light = headAmbient + max(dot(n, -forward), 0.0) * headDiffuse + max(lit, 0.0) * sunDiffuse;
  color = vec4(clamp(rgba.rgb * (light + emission) + specular * shine * sunSpecular, 0.0, 1.0), rgba.a);
  place = 0.5 * textureScale * vec2(corner.x, -corner.y) - 0.5;
  gl_Position = clipFromWorld * vec4(point, 1.0);
}`;

const FRAGMENT_SHADER = `#version 300 es
precision highp float;
uniform sampler2D picture;
uniform vec3 gains;
uniform float noise, moment;
in vec4 color;
in vec2 place;
out vec4 pixel;
float random(vec3 at) { return fract(sin(dot(at, vec3(12.9898, 78.233, 37.719))) * 43758.5453); }
float normalNoise(float channel) {
  vec2 u = vec2(random(vec3(gl_FragCoord.xy, channel + moment)), random(vec3(gl_FragCoord.yx, moment - channel)));
  return sqrt(-2.0 * log(max(u.x, 1e-6))) * cos(6.2831853 * u.y);
}
void main() {
  pixel = color * texture(picture, place);
  pixel.rgb = pixel.rgb * gains + noise * vec3(normalNoise(1.0), normalNoise(2.0), normalNoise(3.0));
}`;

/** Thrown where a browser has no WebGL 2. */
class NoWebGL extends Error {
  constructor() {
    super("This browser cannot draw here: it has no WebGL 2, or it is turned off.");
  }
}

export class Drawer {
  /** @param side width and height of what is drawn, in pixels */
  constructor(mujoco, model, side, quality = FINE) {
    this._canvas = document.createElement("canvas");
    this._canvas.width = this._canvas.height = side;
    const gl = this._canvas.getContext("webgl2", {
      antialias: quality.antialias,
      preserveDrawingBuffer: true,
    });
    if (gl === null) throw new NoWebGL();
    this._gl = gl;
    this._program = compile(gl);
    gl.useProgram(this._program);
    this._places = new Map();
    this._meshes = Object.fromEntries(
      Object.entries(meshes).map(([name, make]) => [name, upload(gl, make(quality))]),
    );
    const { mjtGeom } = mujoco;
    this._partOf = new Map(Object.entries(PARTS).map(([type, part]) => [mjtGeom[`mjGEOM_${type}`].value, part]));
    this._capsule = mjtGeom.mjGEOM_CAPSULE.value;
    this._rgbRole = mujoco.mjtTextureRole.mjTEXROLE_RGB.value;
    this._numRoles = mujoco.mjtTextureRole.mjNTEXROLE.value;
    this._textures = [...Array(model.ntex).keys()].map((i) => textureOf(gl, model, i));
    this._white = whiteTexture(gl);
  }

  /** Whether the browser has taken the graphics context away. */
  get isLost() {
    return this._gl.isContextLost();
  }

  /**
   * Draw a named camera onto a 2D canvas.
   *
   * @param sensor {gains, noise in grey levels} of the camera, or undefined
   */
  draw(scene, camera, canvas, sensor) {
    this._render(scene, camera, sensor);
    canvas.getContext("2d").drawImage(this._canvas, 0, 0, canvas.width, canvas.height);
  }

  /** What a named camera shows: RGBA of its pixels, from the top left. */
  pixels(scene, camera, sensor) {
    this._render(scene, camera, sensor);
    const { width, height } = this._canvas;
    const upward = new Uint8Array(4 * width * height);
    this._gl.readPixels(0, 0, width, height, this._gl.RGBA, this._gl.UNSIGNED_BYTE, upward);
    const lines = [...Array(height).keys()].reverse();
    const downward = new Uint8Array(upward.length);
    lines.forEach((line, i) => downward.set(upward.subarray(4 * width * line, 4 * width * (line + 1)), 4 * width * i));
    return downward;
  }

  _render(scene, camera, sensor) {
    const { _gl: gl } = this;
    gl.viewport(0, 0, this._canvas.width, this._canvas.height);
    gl.clearColor(0, 0, 0, 1);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
    gl.depthFunc(gl.LEQUAL);
    const view = viewOf(scene, camera);
    this._light(scene.model, scene.data, view);
    this._set("gains", sensor?.gains ?? [1, 1, 1]);
    this._set("noise", (sensor?.noise ?? 0) / 255);
    this._set("moment", sensor ? Math.random() : 0);
    const shown = this._shownGeoms(scene.model);
    gl.disable(gl.BLEND);
    for (const geom of shown.filter(({ rgba }) => rgba[3] >= OPAQUE)) this._drawGeom(scene, geom);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ZERO, gl.ONE);
    gl.depthMask(false);
    const transparent = shown.filter(({ rgba }) => rgba[3] < OPAQUE);
    for (const geom of [...transparent, ...transparent.reverse()]) this._drawGeom(scene, geom); // twice, as MuJoCo
  }

  _light(model, data, { eye, forward, clipFromWorld }) {
    const { headlight } = model.vis;
    this._set("clipFromWorld", clipFromWorld);
    this._set("eye", eye);
    this._set("forward", forward);
    this._set("headAmbient", headlight.ambient);
    this._set("headDiffuse", headlight.diffuse);
    this._set("sun", data.light_xdir.slice(0, 3));
    this._set("sunDiffuse", model.light_diffuse.slice(0, 3));
    this._set("sunSpecular", model.light_specular.slice(0, 3));
  }

  _shownGeoms(model) {
    const { geom_rgba: colors, geom_matid: materials, geom_group: groups } = model;
    const shown = [];
    for (let id = 0; id < model.ngeom; id++) {
      const own = [...colors.slice(4 * id, 4 * id + 4)];
      const material = materials[id];
      const isOwn = material < 0 || own.some((value, i) => value !== DEFAULT_RGBA[i]);
      const rgba = isOwn ? own : [...model.mat_rgba.slice(4 * material, 4 * material + 4)];
      if (groups[id] < SHOWN_GROUPS && rgba[3] > 0) shown.push({ id, rgba, ...this._surface(model, material) });
    }
    return shown;
  }

  _surface(model, material) {
    if (material < 0) return NO_MATERIAL;
    return {
      emission: model.mat_emission[material],
      specular: model.mat_specular[material],
      shininess: model.mat_shininess[material],
      texture: model.mat_texid[this._numRoles * material + this._rgbRole],
      isUniform: built.TEXTURE_IS_UNIFORM[material],
      repeat: [...model.mat_texrepeat.slice(2 * material, 2 * material + 2)],
    };
  }

  _drawGeom({ model, data }, geom) {
    const { _gl: gl } = this;
    const { id, texture } = geom;
    const size = [...model.geom_size.slice(3 * id, 3 * id + 3)];
    const turn = [...data.geom_xmat.slice(9 * id, 9 * id + 9)];
    const center = [...data.geom_xpos.slice(3 * id, 3 * id + 3)];
    this._set("rgba", geom.rgba);
    this._set("emission", geom.emission);
    this._set("specular", geom.specular);
    this._set("shininess", geom.shininess);
    this._set("turn", [0, 3, 6, 1, 4, 7, 2, 5, 8].map((i) => turn[i]));
    gl.bindTexture(gl.TEXTURE_2D, texture < 0 ? this._white : this._textures[texture]);
    this._set("textureScale", texture < 0 ? [0, 0] : geom.repeat.map((n, i) => (geom.isUniform ? n * size[i] : n)));
    const type = model.geom_type[id];
    if (type === this._capsule) {
      const [radius, half] = size;
      const end = (side) => center.map((value, i) => value + side * half * turn[3 * i + 2]);
      this._drawPart("openCylinder", center, [radius, radius, half]);
      for (const side of [-1, 1]) this._drawPart("sphere", end(side), [radius, radius, radius]);
    } else {
      const isRound = this._partOf.get(type) === "cylinder";
      const isFlat = this._partOf.get(type) === "plane";
      this._drawPart(this._partOf.get(type), center, [
        size[0],
        isRound ? size[0] : size[1],
        isRound ? size[1] : isFlat ? 1 : size[2],
      ]);
    }
  }

  _drawPart(part, position, size) {
    const { _gl: gl } = this;
    const { array, count } = this._meshes[part];
    this._set("position", position);
    this._set("size", size);
    gl.bindVertexArray(array);
    gl.drawArrays(gl.TRIANGLES, 0, count);
  }

  _set(name, value) {
    const { _gl: gl, _places: places } = this;
    if (!places.has(name)) places.set(name, gl.getUniformLocation(this._program, name));
    const place = places.get(name);
    if (typeof value === "number") gl.uniform1f(place, value);
    else if (value.length === 16) gl.uniformMatrix4fv(place, false, value);
    else if (value.length === 9) gl.uniformMatrix3fv(place, false, value);
    else gl[`uniform${value.length}fv`](place, value);
  }
}

/** Where a camera is, and its matrix from the world to clip space (column by column). */
function viewOf({ model, data }, camera) {
  const { id } = model.cam(camera);
  const eye = [...data.cam_xpos.slice(3 * id, 3 * id + 3)];
  const turn = [...data.cam_xmat.slice(9 * id, 9 * id + 9)];
  const axis = (k) => [turn[k], turn[3 + k], turn[6 + k]];
  const [right, up, backward] = [0, 1, 2].map(axis);
  const { znear, zfar } = model.vis.map;
  const near = znear * model.stat.extent;
  const far = zfar * model.stat.extent;
  const focal = 1 / Math.tan((model.cam_fovy[id] * Math.PI) / 360);
  const along = (vector) => -vector.reduce((sum, value, i) => sum + value * eye[i], 0);
  const depth = (far + near) / (near - far);
  const rows = [
    [...right, along(right)].map((value) => focal * value),
    [...up, along(up)].map((value) => focal * value),
    [...backward, along(backward)].map((value, i) => depth * value + (i === 3 ? (2 * far * near) / (near - far) : 0)),
    [...backward, along(backward)].map((value) => -value),
  ];
  const clipFromWorld = [0, 1, 2, 3].flatMap((column) => rows.map((row) => row[column]));
  return { eye, right, up, forward: backward.map((value) => -value), focal, clipFromWorld };
}

/** World x and y, at a height, of a point of a camera's image; x and y of the image in [-1, 1]. */
export function pointAt(scene, camera, [x, y], heightM) {
  const { eye, right, up, forward, focal } = viewOf(scene, camera);
  const ray = forward.map((value, i) => value + (x * right[i] + y * up[i]) / focal);
  const distance = (heightM - eye[2]) / ray[2];
  return [0, 1].map((i) => eye[i] + distance * ray[i]);
}

function compile(gl) {
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX_SHADER], [gl.FRAGMENT_SHADER, FRAGMENT_SHADER]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new NoWebGL();
  return program;
}

function upload(gl, corners) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(corners), gl.STATIC_DRAW);
  for (const location of [0, 1]) {
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, 3, gl.FLOAT, false, 24, 12 * location);
  }
  return { array, count: corners.length / 6 };
}

function textureOf(gl, model, index) {
  const [width, height] = [model.tex_width[index], model.tex_height[index]];
  const start = Number(model.tex_adr[index]);
  return uploadTexture(gl, width, height, model.tex_data.slice(start, start + 3 * width * height));
}

function whiteTexture(gl) {
  return uploadTexture(gl, 1, 1, new Uint8Array([255, 255, 255]));
}

function uploadTexture(gl, width, height, rgb) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, width, height, 0, gl.RGB, gl.UNSIGNED_BYTE, rgb);
  gl.generateMipmap(gl.TEXTURE_2D);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
  return texture;
}
