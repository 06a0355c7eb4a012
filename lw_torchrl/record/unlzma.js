// Decompress LZMA as Python's lzma.FORMAT_ALONE writes it: a header of 13 bytes, then the range coder's output.
function unlzma(input, size) {
  const lc = input[0] % 9, rest = (input[0] / 9) | 0, lp = rest % 5, pb = (rest / 5) | 0;
  const out = new Uint8Array(size), chances = (count) => new Uint16Array(count).fill(1024);
  let at = 14, range = 0xffffffff, code = 0;
  for (let i = 0; i < 4; i++) code = ((code << 8) | input[at++]) >>> 0;
  const bit = (p, i) => {
    const bound = (range >>> 11) * p[i];
    let got = 0;
    if (code < bound) { range = bound; p[i] += (2048 - p[i]) >> 5; }
    else { range -= bound; code -= bound; p[i] -= p[i] >> 5; got = 1; }
    if (range < 0x1000000) { range = (range << 8) >>> 0; code = ((code << 8) | input[at++]) >>> 0; }
    return got;
  };
  const tree = (p, start, bits) => {
    let m = 1;
    for (let i = 0; i < bits; i++) m = (m << 1) | bit(p, start + m);
    return m - (1 << bits);
  };
  const reversed = (p, start, bits) => {
    let m = 1, found = 0;
    for (let i = 0; i < bits; i++) { const b = bit(p, start + m); m = (m << 1) | b; found |= b << i; }
    return found;
  };
  const direct = (bits) => {
    let found = 0;
    for (; bits > 0; bits--) {
      range >>>= 1;
      const b = code >= range ? 1 : 0;
      if (b) code -= range;
      if (range < 0x1000000) { range = (range << 8) >>> 0; code = ((code << 8) | input[at++]) >>> 0; }
      found = (found << 1) | b;
    }
    return found >>> 0;
  };
  const lengths = () => ({ choice: chances(2), low: chances(16 << 3), mid: chances(16 << 3), high: chances(256) });
  const length = (p, pos) => {
    if (!bit(p.choice, 0)) return 2 + tree(p.low, pos << 3, 3);
    return bit(p.choice, 1) ? 18 + tree(p.high, 0, 8) : 10 + tree(p.mid, pos << 3, 3);
  };
  const literal = chances(0x300 << (lc + lp)), match = chances(192), rep = chances(12), rep0 = chances(12);
  const rep1 = chances(12), rep2 = chances(12), long0 = chances(192), slots = chances(256), special = chances(128);
  const aligned = chances(16), matches = lengths(), repeats = lengths();
  let done = 0, state = 0, d0 = 0, d1 = 0, d2 = 0, d3 = 0;
  while (done < size) {
    const pos = done & ((1 << pb) - 1);
    if (!bit(match, (state << 4) + pos)) {
      const before = done ? out[done - 1] : 0;
      const base = 0x300 * (((done & ((1 << lp) - 1)) << lc) + (before >> (8 - lc)));
      let m = 1;
      if (state >= 7) {
        let other = out[done - d0 - 1];
        do {
          const b = (other >> 7) & 1;
          other <<= 1;
          const got = bit(literal, base + ((1 + b) << 8) + m);
          m = (m << 1) | got;
          if (b !== got) break;
        } while (m < 0x100);
      }
      while (m < 0x100) m = (m << 1) | bit(literal, base + m);
      out[done++] = m;
      state = state < 4 ? 0 : state < 10 ? state - 3 : state - 6;
      continue;
    }
    let count;
    if (bit(rep, state)) {
      if (!bit(rep0, state)) {
        if (!bit(long0, (state << 4) + pos)) {
          state = state < 7 ? 9 : 11;
          out[done] = out[done - d0 - 1];
          done++;
          continue;
        }
      } else {
        let d = d1;
        if (bit(rep1, state)) {
          d = d2;
          if (bit(rep2, state)) { d = d3; d3 = d2; }
          d2 = d1;
        }
        d1 = d0;
        d0 = d;
      }
      count = length(repeats, pos);
      state = state < 7 ? 8 : 11;
    } else {
      d3 = d2; d2 = d1; d1 = d0;
      count = length(matches, pos);
      state = state < 7 ? 7 : 10;
      const slot = tree(slots, Math.min(count - 2, 3) << 6, 6);
      d0 = slot;
      if (slot > 3) {
        const bits = (slot >> 1) - 1;
        d0 = ((2 | (slot & 1)) << bits) >>> 0;
        if (slot < 14) d0 += reversed(special, d0 - slot, bits);
        else d0 += direct(bits - 4) * 16 + reversed(aligned, 0, 4);
      }
    }
    for (const end = Math.min(done + count, size); done < end; done++) out[done] = out[done - d0 - 1];
  }
  return out;
}
