// The byte-level BPE of the policies' small backbones: text -> tokens.

// each digit alone; else as GPT-2 splits text
const PIECES = /\d|'(?:s|t|re|ve|m|ll|d)| ?\p{L}+| ?[^\s\p{L}\d]+|\s+(?!\S)|\s+/gu;

/** {byte: the character that stands for it}, as GPT-2 writes bytes. */
function byteCharacters() {
  const isShown = (byte) => (byte >= 33 && byte <= 126) || (byte >= 161 && byte <= 172) || byte >= 174;
  let next = 256;
  return [...Array(256).keys()].map((byte) => String.fromCodePoint(isShown(byte) ? byte : next++));
}

export class Tokenizer {
  constructor({ vocab, merges }) {
    this._vocab = vocab;
    this._ranks = new Map(merges.map((pair, rank) => [pair, rank]));
    this._characters = byteCharacters();
    this._encoder = new TextEncoder();
  }

  /** The tokens of an instruction, in lower case as policies read it. */
  encode(instruction) {
    const text = instruction.toLowerCase().replace(/[_\r\n]/g, " ").trim();
    return [...text.matchAll(PIECES)].flatMap(([piece]) => this._merge(piece).map((part) => this._vocab[part]));
  }

  _merge(piece) {
    let parts = [...this._encoder.encode(piece)].map((byte) => this._characters[byte]);
    for (;;) {
      const ranks = parts.slice(1).map((part, i) => this._ranks.get(`${parts[i]} ${part}`) ?? Infinity);
      const best = Math.min(...ranks);
      if (best === Infinity) return parts;
      const merged = [];
      for (let i = 0; i < parts.length; i++) {
        if (ranks[i] === best) merged.push(parts[i] + parts[++i]);
        else merged.push(parts[i]);
      }
      parts = merged;
    }
  }
}
