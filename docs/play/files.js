// Files beside the page, which lie there gzipped: a page without them weighs a third.

const GZIP = [0x1f, 0x8b]; // how such a file begins

/** Read a file's bytes. */
export async function readBytes(name) {
  const response = await fetch(`${name}.gz`);
  if (!response.ok) throw new Error(`The server answers ${response.status} for ${name}; reload the page.`);
  const bytes = new Uint8Array(await response.arrayBuffer());
  if (!GZIP.every((byte, i) => bytes[i] === byte)) return bytes; // some servers make browsers unpack it
  const unpacked = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(unpacked).arrayBuffer());
}

export async function readText(name) {
  return new TextDecoder().decode(await readBytes(name));
}

export async function readJson(name) {
  return JSON.parse(await readText(name));
}
