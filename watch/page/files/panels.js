// Everything on the page but the curves: numbers, meters, tables, events.
import { drawHistogram } from "./charts.js";

const $ = (id) => document.getElementById(id);
const text = (id, value) => { const e = $(id); if (e.textContent !== value) e.textContent = value; };
export const fixed = (value, digits, unit = "") => (typeof value === "number" ? `${value.toFixed(digits)}${unit}` : "-");

const NUMBERS = [
  ["angle", (s) => fixed(s.cycle?.angle_deg, 2, " deg"), "big"],
  ["reference", (s) => fixed(s.cycle?.reference_deg, 2, " deg")],
  ["error", (s) => fixed(s.cycle?.error_deg, 3, " deg"), "big"],
  ["chamber pressure", (s) => fixed(s.cycle?.chamber_pressure_kpa, 2, " kPa")],
  ["desired pressure", (s) => fixed(s.cycle?.desired_pressure_kpa, 2, " kPa")],
  ["supply pressure", (s) => fixed(s.cycle?.supply_pressure_kpa, 1, " kPa")],
  ["charge current", (s) => fixed(s.cycle?.charge_current_ma, 1, " mA")],
  ["exhaust current", (s) => fixed(s.cycle?.exhaust_current_ma, 1, " mA")],
  ["coils, charge / exhaust", (s) => `${fixed(s.coils?.charge_ma, 1)} / ${fixed(s.coils?.exhaust_ma, 1)} mA`],
  ["working mode", (s) => s.mode ?? "-"],
  ["gate's output", (s) => s.gate.output],
  ["valve driver", (s) => s.gate.driver],
  ["off the shadow, RMS", (s) => (s.shadow ? `${fixed(s.shadow.angle_rms_deg, 2, " deg")}, ${fixed(s.shadow.chamber_rms_kpa, 2, " kPa")}` : "-")],
  ["ticks skipped", (s) => (s.cycle ? `${s.cycle.skipped_total}` : "-")],
];

export class Panels {
  constructor(hello) {
    this.hello = hello;
    this.budgets = hello.budgets_ms || {};
    text("bench", hello.bench || "softloop");
    showLaw(hello);
    document.title = `${hello.bench || ""} softloop`;
    this.numbers = rowsOf($("numbers"), NUMBERS.map(([name]) => name), "dt", "dd");
    NUMBERS.forEach(([, , kind], i) => kind && this.numbers[i].classList.add(kind));
    this.meters = new Map();
    $("inputs").replaceChildren();
    this.parameters(hello.parameters || []);
  }

  parameters(list) {
    const place = $("parameters");
    place.replaceChildren();
    this.tracks = list.map(({ name, min, max, value }) => {
      const label = make("span", "name", name), track = make("div", "track"), shown = make("span", "value", "");
      const mark = document.createElement("i");
      track.title = `${name}: ${min.toPrecision(4)} to ${max.toPrecision(4)}, from the file ${value.toPrecision(4)}`;
      track.style.setProperty("--start", `${place01(value, min, max) * 100}%`);
      track.append(mark);
      place.append(label, make("span", "bound", bound(min)), track, make("span", "bound high", bound(max)), shown);
      return { mark, shown, min, max };
    });
  }

  state(s) {
    NUMBERS.forEach(([, of], i) => { const v = of(s); if (this.numbers[i].textContent !== v) this.numbers[i].textContent = v; });
    const gate = $("gate"), why = s.gate.reason !== "none" && s.gate.state !== "silent" ? s.gate.reason : "";
    gate.dataset.gate = s.gate.state;
    text("gate", `gate ${s.gate.state}`);
    $("reason").hidden = !why;
    text("reason", why);
    text("phase", s.phase && s.running ? `phase ${s.phase}, ${fixed(Math.max(0, s.trajectory_s), 1)} s on the trajectory` : "-");
    this.lateness(s.late);
    this.inputs(s);
    this.theta(s.theta, s.adapting);
    this.processes(s.processes);
  }

  lateness(late) {
    drawHistogram($("lateness"), late.counts, this.hello.late_edges_ms);
    const words = `last ten seconds: median ${fixed(late.p50 / 1e3, 2)}, 99 % ${fixed(late.p99 / 1e3, 2)}, most ${fixed(late.max / 1e3, 2)} ms`;
    text("lateness-text", late.p50 === undefined ? "no tick yet" : words);
  }

  inputs(s) {
    for (const [name, age] of Object.entries(s.ages_ms || {})) {
      const budget = this.budgets[name] || 30;
      this.meter(`${name} age`, age / budget, `${fixed(age, 1)} of ${budget} ms`);
    }
    for (const [name, load] of Object.entries(s.buses)) this.meter(`CAN ${name}`, load / 100, `${fixed(load, 1)} %`);
    for (const [name, rate] of Object.entries(s.rates)) if (name !== "can") this.meter(`${name} rate`, rate / 250, `${fixed(rate, 0)} Hz`, true);
  }

  meter(name, part, words, plain) {
    if (!this.meters.has(name)) {
      const bar = make("div", "bar"), fill = document.createElement("i"), value = make("span", "value", "");
      bar.append(fill);
      $("inputs").append(make("span", "", name), bar, value);
      this.meters.set(name, { fill, value });
    }
    const { fill, value } = this.meters.get(name);
    fill.style.width = `${Math.min(100, Math.max(0, part * 100))}%`;
    fill.classList.toggle("high", !plain && part > 0.8);
    value.textContent = words;
  }

  theta(theta, adapting) {
    text("adapting", theta ? (adapting ? "adapting" : "held") : "");
    (theta || []).forEach((value, i) => {
      const track = this.tracks[i];
      if (!track || value === null) return;
      const at = place01(value, track.min, track.max);
      track.mark.style.left = `${at * 100}%`;
      track.mark.classList.toggle("edge", at <= 0.005 || at >= 0.995);
      track.shown.textContent = value.toPrecision(4);
    });
  }

  processes(list) {
    const body = $("processes").tBodies[0];
    while (body.rows.length > list.length) body.deleteRow(-1);
    list.forEach((p, i) => {
      const row = body.rows[i] || body.insertRow();
      const cells = [p.name, p.heard_s > 2.5 ? `silent ${fixed(p.heard_s, 0)} s` : p.state, fixed(p.late_ms, 2), `${p.skipped}`, `${p.dropped}`];
      cells.forEach((words, c) => { const cell = row.cells[c] || row.insertCell(); if (cell.textContent !== words) cell.textContent = words; });
      row.classList.toggle("silent", p.heard_s > 2.5);
      row.title = `pid ${p.pid}, real-time priority ${p.realtime ? "granted" : "not granted"}`;
    });
  }

  events(list) {
    $("events").replaceChildren(...list.map((event) => {
      const line = make("li", /fault|lost|watchdog/.test(event.text) ? "fault" : "");
      line.append(make("time", "", fixed(event.time_s, 2)), make("span", "", event.text));
      return line;
    }));
  }
}

// Which law on which trajectory; of a file its name alone.
export function showLaw({ law, trajectory }) {
  text("law", [law, trajectory && trajectory.split("/").pop()].filter(Boolean).join(" on "));
  $("law").title = trajectory || "";
}

// A bound in few characters: 0.062, 3e-7.
function bound(value) {
  return Number(value.toPrecision(2)).toString();
}

function place01(value, min, max) {
  return max > min ? Math.min(1, Math.max(0, (value - min) / (max - min))) : 0.5;
}

function rowsOf(place, names, term, value) {
  place.replaceChildren();
  return names.map((name) => {
    const cell = make(value, "", "-");
    place.append(make(term, "", name), cell);
    return cell;
  });
}

export function make(tag, kind, words) {
  const element = document.createElement(tag);
  if (kind) element.className = kind;
  if (words !== undefined) element.textContent = words;
  return element;
}
