"use strict";
// Everything that came from outside is set as text, never as markup.
const POINTS = 400;
const at = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
const MANY = 12; // rows of a table that can be read without a search
let points = [], source = null, plant = new URLSearchParams(location.search).get("plant"), chosen = null, last = null;

function made(tag, text, name) {
  const element = document.createElement(tag);
  if (text !== undefined) element.textContent = text;
  if (name) element.className = name;
  return element;
}

function short(value, digits = 5) {
  if (value === null || !Number.isFinite(value)) return "none";
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e5 || size < 1e-3)) return value.toExponential(2);
  return value.toLocaleString("en", { maximumSignificantDigits: digits, useGrouping: false });
}

const seconds = (time) => (typeof time === "string" ? Date.parse(time) / 1000 : time);
const order = (names) => [...names].sort((a, b) => a.localeCompare(b, "en", { numeric: true }));
const united = (name, unit) => (unit ? name + " (" + unit + ")" : name);

// A value and two deviations, both to two digits of the deviation.
function rounded(mean, wide) {
  if (mean === null || !Number.isFinite(mean)) return ["none", "none"];
  if (!wide) return [short(mean), ""];
  const places = 1 - Math.floor(Math.log10(wide));
  if (places > 12 || places < -12 || Math.abs(mean) >= 1e9) return [short(mean), short(wide, 2)];
  const cut = (value) => (places >= 0 ? value.toFixed(places) : (Math.round(value * 10 ** places) / 10 ** places).toFixed(0));
  return [cut(mean), cut(wide)];
}

// Ticks at 1, 2 or 5 times a power of ten, and the decimals that they need.
function ticks(low, high, count) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((n) => n * power).find((size) => size >= raw * 0.999);
  const from = Math.ceil(low / step - 1e-9), to = Math.floor(high / step + 1e-9);
  const digits = Math.min(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), 12);
  const text = (value) => (Math.abs(value) >= 1e6 || digits > 6 ? short(value) : value.toFixed(digits));
  return Array.from({ length: Math.max(0, to - from + 1) }, (_, i) => (from + i) * step).map((value) => [value, text(value)]);
}

function timeTicks(row, from, to, count) {
  if (typeof row[0].time !== "string") return ticks(from, to, count);
  const span = to - from, sizes = [0.1, 0.5, 1, 5, 10, 30, 60, 300, 600, 1800, 3600, 10800, 21600, 43200, 86400, 604800];
  const step = sizes.find((size) => size >= span / count) || span / count;
  const text = (time) => (step >= 86400 ? new Date(time * 1000).toLocaleDateString() : new Date(time * 1000).toLocaleTimeString());
  const start = Math.ceil(from / step), number = Math.floor(to / step) - start + 1;
  return Array.from({ length: Math.max(0, number) }, (_, i) => (start + i) * step).map((time) => [time, text(time)]);
}

function connect() {
  if (source) source.close();
  source = new EventSource("events" + (plant === null ? "" : "?plant=" + encodeURIComponent(plant)));
  source.onopen = () => status(true);
  source.onerror = () => status(false);
  source.onmessage = (event) => show(JSON.parse(event.data));
}

function status(on) {
  at("state").textContent = on ? "live" : "connection lost, trying again";
  at("state").classList.toggle("on", on);
}

function choose(select, options, value, change) {
  const known = JSON.stringify(options);
  if (select.dataset.known !== known) {
    select.dataset.known = known;
    select.replaceChildren(...options.map((name) => { const option = made("option", name || "(no name)"); option.value = name; return option; }));
  }
  select.value = value;
  select.onchange = () => change(select.value);
  select.parentElement.hidden = options.length < 2;
}

function show(view) {
  last = view;
  const newest = new Map();
  for (const point of view.since ? points.concat(view.points) : view.points)
    if (point.final || !(newest.get(point.time) || point).final) newest.set(point.time, point);
  points = [...newest.values()].sort((a, b) => seconds(a.time) - seconds(b.time)).slice(-POINTS);
  const name = view.title || view.plant || "heliograph";
  at("title").textContent = document.title = name;
  at("which").textContent = view.plants.length ? (view.plant && view.title ? "plant " + view.plant : "") : "waiting for messages";
  at("which").hidden = !at("which").textContent || view.plants.length > 1;
  choose(at("plant"), view.plants, view.plant, (name) => { plant = name; connect(); });
  at("warnings").replaceChildren(...view.warnings.map((text) => made("li", text)));
  keys(view);
  charts(view);
  levels(view);
  links(view);
  tests(view);
  outputs(view);
}

const REASONS = ["limits", "code", "stuck", "flag", "counter"];

function counted(number) {  // messages without a count of their own say nothing of lost ones
  return number === null ? "not counted" : number.toLocaleString("en");
}

function keys(view) {
  const sum = (name, of) => Object.values(of).reduce((total, link) => total + link[name], 0);
  const all = view.all;
  const rows = [["plants", view.count], ["messages used", sum("used", all)], ["lost", Object.values(all).some((link) => link.lost !== null) || !Object.keys(all).length ? sum("lost", all) : null],
    ["too late", sum("late", all)], ["copies", sum("duplicate", all)], ["implausible", sum("implausible", all)],
    ["not readable", view.malformed]];
  at("keys").replaceChildren(...rows.map(([name, value]) => {
    const key = made("div", undefined, "key"), shown = made("dd", counted(value));
    if (name === "plants" && value > 1) {  // all of them, the worst first
      const link = made("a", shown.textContent + (view.wrong ? " (" + view.wrong.toLocaleString("en") + " wrong)" : ""));
      link.href = "plants";
      shown.replaceChildren(link);
    }
    key.append(made("dt", name), shown);
    return key;
  }));
}

function charts(view) {
  if (!points.length) return at("charts").replaceChildren();
  const newest = points[points.length - 1].estimates;
  const pairs = new Map(order(Object.keys(newest)).flatMap((node) => order(Object.keys(newest[node])).map((name) => [node + "/" + name, [node, name]])));
  const names = [...pairs.keys()];
  const first = names.find((name) => name.startsWith("fused/")) || names[0];
  if (!pairs.has(chosen)) chosen = first;
  choose(at("filter"), names, chosen, (name) => { chosen = name; charts(last); });
  const [node, filter] = pairs.get(chosen);
  // What became final since it was provisional is not drawn twice.
  const end = Math.max(...points.filter((point) => point.final).map((point) => seconds(point.time)));
  const drawn = points.filter((point) => point.final || !(seconds(point.time) <= end));
  const rows = drawn.flatMap((point) => {
    const estimate = point.estimates[node] && point.estimates[node][filter];
    return estimate ? [{ time: point.time, final: point.final, estimate }] : [];
  });
  const over = (name, unit, of) => chart(name, unit, view.time_unit, rows.map((row) => ({ ...row, ...of(row.estimate), claim: row.estimate.claim })).filter((row) => Number.isFinite(row.mean)));
  // Of a filter that weighs modes, their probabilities too.
  const modes = rows.length ? rows[rows.length - 1].estimate.modes || [] : [];
  at("charts").replaceChildren(
    ...view.states.map((state, i) => over(state, view.units[i], (estimate) => ({ mean: estimate.mean[i], wide: estimate.deviation ? 2 * estimate.deviation[i] : 0 }))),
    ...modes.map((_, j) => over("probability of mode " + j, "", (estimate) => ({ mean: estimate.modes ? estimate.modes[j] : NaN, wide: 0 }))));
}

function drawing(width, height) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 " + width + " " + height);
  svg.setAttribute("role", "img");
  const add = (tag, name, values, text) => {
    const element = document.createElementNS(SVG, tag);
    element.setAttribute("class", name);
    for (const [key, value] of Object.entries(values)) element.setAttribute(key, typeof value === "number" ? value.toFixed(1) : value);
    if (text !== undefined) element.textContent = text;
    svg.append(element);
  };
  return [svg, add];
}

function chart(name, unit, timeUnit, row) {
  const figure = made("figure"), caption = made("figcaption");
  caption.append(made("b", united(name, unit)));
  figure.append(caption);
  if (!row.length) return figure;
  const end = row[row.length - 1], [mean, wide] = rounded(end.mean, end.wide);
  const tail = unit ? " " + unit : "";
  caption.append(made("span", mean + (wide ? " ± " + wide : "") + tail + (wide ? " (two deviations), " : ", ") + end.claim));
  const ranges = row.map((p) => [p.mean - p.wide, p.mean + p.wide]);
  let low = Math.min(...ranges.map((r) => r[0])), high = Math.max(...ranges.map((r) => r[1]));
  const room = (high - low) * 0.06 || Math.abs(high) * 0.1 || 1;
  [low, high] = [low - room, high + room];
  let from = seconds(row[0].time), to = seconds(end.time);
  if (to === from) [from, to] = [from - 1, to + 1];
  // Sizes in pixels, so that text keeps its shape.
  const width = Math.max(260, at("charts").clientWidth < 760 ? at("charts").clientWidth : (at("charts").clientWidth - 20) / 2);
  const left = 62, right = width - 14, top = 8, bottom = 150;
  const x = (time) => left + (right - left) * (time - from) / (to - from), y = (value) => top + (bottom - top) * (high - value) / (high - low);
  const [svg, add] = drawing(width, 188);
  svg.setAttribute("aria-label", united(name, unit) + " over time, now " + mean + (wide ? " ± " + wide + " (two deviations)" : ""));
  for (const [value, text] of ticks(low, high, 4)) {
    add("line", "grid", { x1: left, x2: right, y1: y(value), y2: y(value) });
    add("text", "tick end", { x: left - 6, y: y(value) + 4 }, text);
  }
  for (const [time, text] of timeTicks(row, from, to, width < 420 ? 3 : 4)) {
    add("line", "grid", { x1: x(time), x2: x(time), y1: top, y2: bottom });
    add("text", "tick middle", { x: Math.min(x(time), right - 16), y: bottom + 16 }, text);
  }
  add("text", "tick end", { x: right, y: bottom + 32 }, typeof end.time === "string" ? "time of day" : united("time", timeUnit));
  const line = (of) => of.map(([a, b], i) => (i ? "L" : "M") + a.toFixed(1) + " " + b.toFixed(1)).join("");
  const final = row.filter((p) => p.final), edge = (side) => (p) => [x(seconds(p.time)), y(p.mean + side * p.wide)];
  if (final.some((p) => p.wide)) add("path", "area", { d: line([...final.map(edge(1)), ...final.slice().reverse().map(edge(-1))]) + "Z" });
  if (final.length) add("path", "mean", { d: line(final.map(edge(0))) });
  // From the last final estimate through what may still change, dashed: nothing is missing between them.
  const ahead = [...final.slice(-1), ...row.filter((p) => !p.final)];
  if (ahead.length > 1) add("path", "mean ahead", { d: line(ahead.map(edge(0))) });
  if (ahead.length > 1 && ahead.some((p) => p.wide)) add("path", "area ahead", { d: line([...ahead.map(edge(1)), ...ahead.slice().reverse().map(edge(-1))]) + "Z" });
  for (const p of row.filter((point) => !point.final)) {
    const [cx, cy] = edge(0)(p);
    if (p.wide) add("line", "bar", { x1: cx, x2: cx, y1: edge(1)(p)[1], y2: edge(-1)(p)[1] });
    add("circle", "dot", { cx, cy, r: 2.5 });
  }
  figure.append(svg);
  return figure;
}

function row(name, cells) {
  const element = made("tr"), head = made("th", name);
  head.scope = "row";
  element.append(head, ...cells.map((cell) => (cell instanceof Node ? cell : made("td", cell))));
  return element;
}

// Nodes in the order of their names; of many, those that the search names.
function searched(view) {
  const nodes = order(new Set([...Object.keys(view.links), ...Object.keys(view.senders), ...view.tests.map((test) => test.node)]));
  at("search").hidden = nodes.length <= MANY;
  const text = at("search").hidden ? "" : at("query").value.trim().toLowerCase();
  const some = nodes.filter((node) => node.toLowerCase().includes(text));
  const count = nodes.filter((node) => node !== "fused").length, matches = some.filter((node) => node !== "fused").length;
  at("matches").textContent = text ? matches + " of " + count + " nodes" : count + " nodes";
  return some;
}

const two = (value) => value !== 0 && (Math.abs(value) < 0.1 || Math.abs(value) > 99) ? short(value, 2) : value.toFixed(2);

function status_of(sender) {
  if (!sender) return made("td", "");
  const unit = (value) => (sender.unit === "steps" && value === 1 ? " step" : sender.unit && " " + sender.unit);
  const quiet = sender.silent + sender.provisional;
  if (sender.dead) return made("td", "dead: " + (sender.missed ? sender.missed + " heartbeats missed" : "silent for " + short(quiet) + unit(quiet)), "doubt");
  if (sender.last === null) return made("td", "nothing yet");
  return made("td", sender.silent ? "silent for " + short(sender.silent) + unit(sender.silent) : "sends", "fine");
}

// How far ahead, in words: of messages with dates in seconds, else in the unit of their time.
function distance(ahead, view) {
  const value = Number(ahead), dated = points.length && typeof points[points.length - 1].time === "string";
  if (!dated) return short(value) + " " + (view.time_unit || "ahead");
  const [size, unit] = [[86400, "d"], [3600, "h"], [60, "min"], [1, "s"]].find(([size]) => value >= size && value % size === 0) || [1, "s"];
  return short(value / size) + " " + unit;
}

const LIKELY = 0.9; // as the rule of integrations/monitoring
const percent = (value) => (100 * value).toFixed(value > 0 && value < 0.1 ? 1 : 0) + " %";

function levels(view) {
  at("passing").hidden = !view.levels.length;
  const horizons = [...new Set(view.levels.map((one) => one.ahead))];
  const heads = ["level", "filter", ...horizons.map((ahead) => "in " + distance(ahead, view))];
  at("horizons").replaceChildren(...heads.map((text) => { const head = made("th", text); head.scope = "col"; return head; }));
  const rows = new Map();
  for (const one of view.levels) {
    const key = JSON.stringify([one.level, one.node + "/" + one.filter]);
    rows.set(key, (rows.get(key) || new Map()).set(one.ahead, one));
  }
  at("levels").replaceChildren(...[...rows].map(([key, said]) => {
    const [level, filter] = JSON.parse(key);
    return row(level, [filter, ...horizons.map((ahead) => {
      const one = said.get(ahead);
      return one ? made("td", percent(one.by) + " (" + percent(one.then) + ")", one.by > LIKELY ? "doubt" : "") : "";
    })]);
  }));
}

function links(view) {
  const deciding = Object.keys(view.senders).length > 0, some = searched(view);
  at("sender").hidden = !deciding;
  at("links").replaceChildren(...some.filter((node) => view.links[node] || view.senders[node]).map((node) => {
    const link = view.links[node] || { used: 0, lost: 0, late: 0, duplicate: 0 };
    const checks = view.tests.filter((test) => test.node === node);
    const doubted = checks.some((test) => test.doubt);
    const judged = made("td", checks.length ? (doubted ? "doubtful" : "not refuted") : "", doubted ? "doubt" : "fine");
    const counts = [link.used, link.lost, link.late, link.duplicate];
    return row(node, [...counts.map(counted), judged, ...(deciding ? [status_of(view.senders[node])] : []), refused(link)]);
  }));
}

function refused(link) {  // values by reason, such as "3 limits, 1 stuck"; messages by flag and counter
  const counts = REASONS.filter((reason) => link[reason]).map((reason) => counted(link[reason]) + " " + reason);
  return counts.length ? counts.join(", ") : counted(0);
}

function tests(view) {
  const some = new Map(searched(view).map((node, i) => [node, node === "fused" ? -1 : i]));
  const rows = view.tests.filter((test) => some.has(test.node)).sort((a, b) => some.get(a.node) - some.get(b.node) || a.filter.localeCompare(b.filter));
  at("tests").replaceChildren(...rows.map((test) => row(test.node + "/" + test.filter, [test.claim, ...(test.by.length
    ? [made("td", test.doubt ? "doubtful" : "not refuted", test.doubt ? "doubt" : "fine"), "by " + listed(test.by)]
    : [made("td", two(test.ratio), test.doubt ? "doubt" : "fine"), two(test.low) + " to " + two(test.high)])])));
}

function outputs(view) {
  at("weighed").hidden = !view.outputs.length;
  const number = (value) => value === null ? "" : value.toFixed(2);
  at("outputs").replaceChildren(...view.outputs.map((one) => row(one.output, [one.node + "/" + one.filter,
    made("td", one.words, one.to_blame ? "doubt" : "fine"), number(one.weight), number(one.squared)])));
}

const listed = (names) => names.slice(0, 3).join(", ") + (names.length > 3 ? " and " + (names.length - 3) + " more" : "");
at("query").oninput = () => { if (last) { links(last); tests(last); } };
window.addEventListener("resize", () => { if (last) charts(last); });
const first = JSON.parse(at("first").textContent);
if (first.points.length) show(first);
connect();
