// A shipped policy: what it sees and reads, and a query of its graph in ONNX.
import { observation } from "./constants.js";
import { Drawer, FAST } from "./draw.js";
import { readBytes, readJson } from "./files.js";
import { Tokenizer } from "./tokenizer.js";

class Policy {
  /**
   * @param ort the module of npm's onnxruntime-web
   * @param session of the policy's graph
   * @param record what goes with the graph: tokenizer, noise, sizes
   * @param look called with a scene, a camera and its sensor: what it shows, RGBA from the top left
   */
  constructor(ort, session, record, look) {
    this._ort = ort;
    this._session = session;
    this._record = record;
    this._look = look;
    this._tokenizer = new Tokenizer(record);
  }

  /** The policy as a run takes it: an observation of the run -> a promise of an action. */
  async act(run) {
    const { _ort: ort, _record: record } = this;
    const { image_size: side, num_tokens: numTokens } = record;
    const images = new Float32Array(observation.CAMERAS.length * 3 * side * side);
    observation.CAMERAS.forEach((camera, i) => {
      const rgba = this._look(run.scene, camera, run.episode.sensor);
      const pixels = side * side;
      for (let channel = 0; channel < 3; channel++) {
        const start = (3 * i + channel) * pixels;
        for (let pixel = 0; pixel < pixels; pixel++) images[start + pixel] = rgba[4 * pixel + channel] / 255;
      }
    });
    const tokens = this._tokenizer.encode(run.instruction);
    if (tokens.length > numTokens) throw new Error("The policy cannot read so long an instruction.");
    const noise = record.noise[run.steps];
    const tensor = (type, values, shape) => new ort.Tensor(type, values, shape);
    const { actions } = await this._session.run({
      images: tensor("float32", images, [observation.CAMERAS.length, 3, side, side]),
      state: tensor("float32", Float32Array.from([...run.now.gripperXyz, run.now.fingerOpening]), [1, 4]),
      ids: tensor("int64", BigInt64Array.from({ length: numTokens }, (_, i) => BigInt(tokens[i] ?? 0)), [1, numTokens]),
      mask: tensor("bool", Uint8Array.from({ length: numTokens }, (_, i) => Number(i < tokens.length)), [1, numTokens]),
      noise: tensor("float32", Float32Array.from(noise), [1, noise.length / observation.ACTION_DIM, observation.ACTION_DIM]),
    });
    return [...actions.data.slice(0, observation.ACTION_DIM)];
  }
}

/** Begin a session of a policy's graph; files {wasm, graph, record}; `look` as a Policy takes it. */
export async function openPolicy(ort, { wasm, graph, record }, look) {
  ort.env.wasm.numThreads = 1; // more need headers that a static host does not send
  ort.env.wasm.wasmBinary = wasm.buffer;
  const session = await ort.InferenceSession.create(graph, { executionProviders: ["wasm"] });
  return new Policy(ort, session, record, look);
}

/** Fetch the policy, with what runs it and eyes for it. */
export async function loadPolicy(mujoco, model) {
  const [ort, wasm, graph, record] = await Promise.all([
    import("./ort.js"),
    readBytes("ort.wasm"),
    readBytes("policy.onnx"),
    readJson("policy.json"),
  ]);
  const eyes = new Drawer(mujoco, model, record.image_size, FAST);
  return openPolicy(ort, { wasm, graph, record }, (...seen) => eyes.pixels(...seen));
}
