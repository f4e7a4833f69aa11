// The last ten minutes of rows, at four resolutions, so that a picture never needs more than two thousand points a curve.

export const ROW_S = 0.005;
const GAP_S = 0.1;
// Rows in a bucket, and for how many seconds the level is kept. A bucket is drawn as its lowest and its highest value.
const LEVELS = [{ rows: 1, keep: 14 }, { rows: 8, keep: 34 }, { rows: 32, keep: 124 }, { rows: 128, keep: 604 }];

class Level {
  constructor(columns, rows, keepS) {
    this.rows = rows;
    this.keep = Math.ceil(keepS / ROW_S / rows) * (rows > 1 ? 2 : 1);
    this.data = Array.from({ length: columns }, () => new Float64Array(2 * this.keep));
    this.end = 0;
    this.low = new Float64Array(columns);
    this.high = new Float64Array(columns);
    this.filled = 0;
  }

  add(row) {
    if (this.rows === 1) { this.put(row); return; }
    for (let c = 0; c < row.length; c++) {
      if (this.filled === 0 || row[c] < this.low[c]) this.low[c] = row[c];
      if (this.filled === 0 || row[c] > this.high[c]) this.high[c] = row[c];
    }
    if (++this.filled === this.rows) this.close();
  }

  // The bucket's lowest values stand at its first time, its highest at its last.
  close() {
    if (this.filled === 0) return;
    this.put(this.low);
    if (this.filled > 1) this.put(this.high);
    this.filled = 0;
  }

  put(row) {
    if (this.end === 2 * this.keep) {
      for (const column of this.data) column.copyWithin(0, this.keep);
      this.end = this.keep;
    }
    for (let c = 0; c < row.length; c++) this.data[c][this.end] = row[c];
    this.end++;
  }

  // Views of the columns from time `from` on; no copy.
  since(from) {
    const times = this.data[0];
    let low = Math.max(0, this.end - this.keep), high = this.end;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (times[middle] < from) low = middle + 1; else high = middle;
    }
    const first = Math.max(0, low - 1);
    return this.data.map((column) => column.subarray(first, this.end));
  }
}

export class Store {
  constructor(columns) {
    this.columns = columns;
    this.clear();
  }

  clear() {
    this.levels = LEVELS.map((l) => new Level(this.columns.length, l.rows, l.keep));
    this.gaps = [];
    this.last = -Infinity;
    this.count = 0;
    this.newest = new Float64Array(this.columns.length);
  }

  // A binary message: rows and columns (u32), a time (f64), then f32 row by row, times counting from that time.
  take(buffer) {
    const head = new DataView(buffer);
    const rows = head.getUint32(0, true), columns = head.getUint32(4, true), base = head.getFloat64(8, true);
    const values = new Float32Array(buffer, 16);
    const row = new Float64Array(columns);
    for (let r = 0; r < rows; r++) {
      for (let c = 0; c < columns; c++) row[c] = values[r * columns + c];
      row[0] += base;
      if (row[0] - this.last > GAP_S && this.count) this.note(this.last, row[0]);
      this.last = row[0];
      for (const level of this.levels) level.add(row);
    }
    this.newest.set(row);
    this.count += rows;
  }

  note(from, to) {
    this.gaps.push([from, to]);
    if (this.gaps.length > 200) this.gaps.shift();
    for (const level of this.levels) level.close();
  }

  // The columns of the finest level that covers `seconds` up to `to`.
  view(seconds, to) {
    const level = this.levels.find((l, i) => LEVELS[i].keep >= seconds + 2) || this.levels[this.levels.length - 1];
    return level.since(to - seconds);
  }
}
