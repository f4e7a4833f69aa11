// The curves. One uPlot for each quantity, all over the same time.
/* global uPlot */

const INK = "#3c4650", GRID = "#eceff2";
const BLACK = "#222222", ORANGE = "#d98200", SKY = "#56b4e9", GREEN = "#009e73", BLUE = "#0072b2", RED = "#d55e00";
const MODES = { 1: "charge", 2: "exhaust", 3: "hold" };

// [title, unit, height, curves]; a curve is [column, name, colour, dashed].
const CHARTS = [
  ["Angle", "deg", 210, [["angle_deg", "measured", BLUE], ["reference_deg", "reference", BLACK, true]]],
  ["Error", "deg", 120, [["error_deg", "angle estimate less reference", RED]]],
  ["Pressure", "kPa", 160, [["chamber_pressure_kpa", "chamber", BLUE], ["desired_pressure_kpa", "desired", RED, true],
    ["supply_pressure_kpa", "supply", SKY]]],
  ["Current", "mA", 140, [["charge_current_ma", "charge valve", ORANGE], ["exhaust_current_ma", "exhaust valve", BLUE]]],
  ["Mode", "", 84, [["mode", "working mode", GREEN]]],
];

// Round limits around what is seen, so that the scale stands still while the curve moves.
function limits(low, high) {
  if (!(low <= high)) return [0, 1];
  const span = Math.max(high - low, 0.1, Math.abs(high) * 1e-3);
  const step = 10 ** Math.floor(Math.log10(span)) / 4;
  return [Math.floor((low - 0.04 * span) / step) * step, Math.ceil((high + 0.04 * span) / step) * step];
}

function axis(extra) {
  return { stroke: INK, grid: { stroke: GRID, width: 1 }, ticks: { stroke: GRID, width: 1 }, font: "11px system-ui, sans-serif", ...extra };
}

class Chart {
  constructor(place, [title, unit, height, curves], store, columns, last) {
    this.store = store;
    this.index = curves.map(([column]) => columns.indexOf(column));
    this.height = height;
    this.bare = !last;
    this.box = document.createElement("div");
    this.box.className = "plot";
    this.box.append(heading(title, unit, curves));
    place.append(this.box);
    const ofMode = title === "Mode";
    const gaps = (u, _series, first, final, none) => this.gaps(u, none);
    this.plot = new uPlot({
      width: 300,
      height: height + (last ? 24 : 0),
      legend: { show: false },
      cursor: { drag: { x: false, y: false }, points: { show: false }, sync: { key: "time" } },
      padding: [6, 10, last ? 0 : 4, 0],
      scales: {
        x: { time: false, auto: false },
        y: ofMode ? { auto: false, range: [0.5, 3.5] } : { range: (_u, low, high) => limits(low, high) },
      },
      axes: [
        axis({ show: last, values: (_u, splits) => splits.map((s) => (s < 0 ? "" : `${s}`)), size: 28, grid: { show: false }, ticks: { show: false } }),
        axis({ size: 60, ...(ofMode ? { splits: [1, 2, 3], values: (_u, s) => s.map((v) => MODES[v]), grid: { show: false } } : { space: 28 }) }),
      ],
      series: [{}, ...curves.map(([, name, stroke, dashed]) => ({
        label: name, stroke, width: dashed ? 1.2 : 1.5, dash: dashed ? [6, 4] : undefined, points: { show: false }, gaps,
        paths: ofMode ? uPlot.paths.stepped({ align: 1 }) : undefined,
      }))],
    }, [[0], ...curves.map(() => [null])], this.box);
  }

  // Where nothing came: no line, in pixels.
  gaps(u, found) {
    for (const [from, to] of this.store.gaps) {
      const left = u.valToPos(from, "x", true), right = u.valToPos(to, "x", true);
      if (right > u.bbox.left && left < u.bbox.left + u.bbox.width) found.push([Math.round(left), Math.round(right)]);
    }
    return found;
  }

  draw(view, from, to) {
    this.plot.batch(() => {
      this.plot.setData([view[0], ...this.index.map((i) => view[i])], false);
      this.plot.setScale("x", { min: from, max: to });
    });
  }

  fit(width) {
    if (width > 50) this.plot.setSize({ width, height: this.plot.height });
  }
}

function heading(title, unit, curves) {
  const head = document.createElement("div");
  head.className = "plot-head";
  const name = document.createElement("b");
  name.textContent = unit ? `${title} (${unit})` : title;
  head.append(name);
  for (const [, label, color, dashed] of curves.length > 1 || title === "Error" ? curves : []) {
    const key = document.createElement("span"), line = document.createElement("i");
    key.className = "key";
    line.style.borderTopColor = color;
    line.classList.toggle("dashed", Boolean(dashed));
    key.append(line, label);
    head.append(key);
  }
  return head;
}

export class Charts {
  constructor(place, store, columns) {
    place.replaceChildren();
    this.store = store;
    this.all = CHARTS.map((chart, i) => new Chart(place, chart, store, columns, i === CHARTS.length - 1));
    const fit = () => this.all.forEach((chart) => chart.fit(place.clientWidth));
    new ResizeObserver(fit).observe(place);
    fit();
  }

  // What draws the `seconds` before `to`, a function for each chart.
  parts(seconds, to) {
    const view = this.store.view(seconds, to);
    return this.all.map((chart) => () => chart.draw(view, to - seconds, to));
  }
}

// Bars over a logarithmic axis of lateness; the counts logarithmic too, because what matters is the rare late tick.
export function drawHistogram(canvas, counts, edges) {
  const scale = window.devicePixelRatio || 1, width = canvas.clientWidth, height = 110;
  const size = [Math.round(width * scale), Math.round(height * scale)];
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size; // costs a new picture each time
  const c = canvas.getContext("2d");
  c.setTransform(scale, 0, 0, scale, 0, 0);
  c.clearRect(0, 0, width, height);
  const base = height - 18, top = Math.log10(1 + Math.max(10, ...counts)), bar = width / counts.length;
  counts.forEach((count, i) => {
    const tall = count ? Math.max(2, (Math.log10(1 + count) / top) * (base - 4)) : 0;
    c.fillStyle = edges[i] >= 5 ? "#c8102e" : edges[i] >= 1 ? "#d98200" : "#56b4e9";
    c.fillRect(i * bar + 0.5, base - tall, bar - 1, tall);
  });
  c.fillStyle = INK;
  c.font = "11px system-ui, sans-serif";
  c.textAlign = "center";
  for (const [ms, text] of [[0.1, "0.1"], [1, "1"], [10, "10 ms"]]) {
    const at = edges.findIndex((edge) => edge >= ms * 0.99);
    c.fillRect(at * bar, base, 1, 4);
    c.fillText(text, at * bar, height - 3);
  }
  c.fillRect(0, base, width, 1);
}
