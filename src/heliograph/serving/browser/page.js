"use strict";
// Everything that came from outside is set as text, never as markup.
const POINTS = 400;
const at = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
let points = [], source = null, plant = null, chosen = null, last = null;

function made(tag, text, name) {
  const one = document.createElement(tag);
  if (text !== undefined) one.textContent = text;
  if (name) one.className = name;
  return one;
}

function short(value, digits = 5) {
  if (value === null || !Number.isFinite(value)) return "none";
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e5 || size < 1e-3)) return value.toExponential(2);
  return value.toLocaleString("en", { maximumSignificantDigits: digits, useGrouping: false });
}

const seconds = (time) => (typeof time === "string" ? Date.parse(time) / 1000 : time);
const clock = (time) => (typeof time === "string" ? new Date(time).toLocaleTimeString() : short(time));

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
    select.replaceChildren(...options.map((name) => { const one = made("option", name || "(no name)"); one.value = name; return one; }));
  }
  select.value = value;
  select.onchange = () => change(select.value);
  select.parentElement.hidden = options.length < 2;
}

function show(view) {
  last = view;
  const newest = new Map((view.since ? points.concat(view.points) : view.points).map((point) => [point.time, point]));
  points = [...newest.values()].sort((a, b) => seconds(a.time) - seconds(b.time)).slice(-POINTS);
  at("title").textContent = view.plant || (view.plants.length ? "estimates" : "waiting for messages");
  choose(at("plant"), view.plants, view.plant, (name) => { plant = name; connect(); });
  at("warnings").replaceChildren(...view.warnings.map((text) => made("li", text)));
  keys(view);
  charts(view);
  links(view);
  tests(view);
}

function keys(view) {
  const sum = (name, of) => Object.values(of).reduce((total, link) => total + link[name], 0);
  const all = view.all;
  const rows = [["plants", view.count], ["messages used", sum("used", all)], ["lost", sum("lost", all)],
    ["too late", sum("late", all)], ["copies", sum("duplicate", all)], ["implausible", sum("implausible", all)],
    ["not readable", view.malformed]];
  at("keys").replaceChildren(...rows.map(([name, value]) => {
    const key = made("div", undefined, "key");
    key.append(made("dt", name), made("dd", value.toLocaleString("en")));
    return key;
  }));
}

function charts(view) {
  if (!points.length) return at("charts").replaceChildren();
  const newest = points[points.length - 1].estimates;
  const names = Object.entries(newest).flatMap(([node, filters]) => Object.keys(filters).map((name) => node + "/" + name));
  if (!names.includes(chosen)) chosen = names[0];
  choose(at("filter"), names, chosen, (name) => { chosen = name; charts(last); });
  const cut = names.find((name) => name === chosen);
  const [node, filter] = Object.entries(newest).flatMap(([n, fs]) => Object.keys(fs).map((f) => [n, f])).find(([n, f]) => n + "/" + f === cut);
  at("charts").replaceChildren(...view.states.map((state, i) => chart(state, points.map((point) => {
    const estimate = point.estimates[node] && point.estimates[node][filter];
    return estimate ? { time: point.time, mean: estimate.mean[i], wide: estimate.deviation ? 2 * estimate.deviation[i] : 0, claim: estimate.claim } : null;
  }).filter((one) => one && Number.isFinite(one.mean)))));
}

function chart(name, row) {
  const figure = made("figure"), caption = made("figcaption");
  caption.append(made("b", name));
  figure.append(caption);
  if (!row.length) return figure;
  const end = row[row.length - 1];
  caption.append(made("span", short(end.mean) + (end.wide ? " ± " + short(end.wide) : "") + ", " + end.claim));
  const from = seconds(row[0].time), to = Math.max(seconds(end.time), from + 1e-9);
  const low = Math.min(...row.map((p) => p.mean - p.wide)), high = Math.max(...row.map((p) => p.mean + p.wide));
  const room = (high - low) * 0.06 || 1;
  const x = (p) => (1000 * (seconds(p.time) - from) / (to - from)).toFixed(1);
  const y = (value) => (300 * (high + room - value) / (high - low + 2 * room)).toFixed(1);
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 1000 300");
  svg.setAttribute("preserveAspectRatio", "none");
  svg.setAttribute("role", "img");
  svg.setAttribute("aria-label", name + " over time, now " + short(end.mean));
  const path = (name, d) => { const one = document.createElementNS(SVG, "path"); one.setAttribute("class", name); one.setAttribute("d", d); svg.append(one); };
  const line = (of) => of.map(([a, b], i) => (i ? "L" : "M") + a + " " + b).join("");
  if (row.some((p) => p.wide))
    path("area", line([...row.map((p) => [x(p), y(p.mean + p.wide)]), ...row.slice().reverse().map((p) => [x(p), y(p.mean - p.wide)])]) + "Z");
  path("mean", line(row.map((p) => [x(p), y(p.mean)])));
  const ends = made("div", undefined, "ends");
  ends.append(made("span", clock(row[0].time)), made("span", short(low) + " to " + short(high)), made("span", clock(end.time)));
  figure.append(svg, ends);
  return figure;
}

function row(name, cells) {
  const one = made("tr"), head = made("th", name);
  head.scope = "row";
  one.append(head, ...cells.map((cell) => (cell instanceof Node ? cell : made("td", cell))));
  return one;
}

function links(view) {
  at("links").replaceChildren(...Object.entries(view.links).map(([node, link]) => {
    const own = view.tests.filter((test) => test.node === node);
    const doubted = own.some((test) => test.doubt);
    const judged = made("td", own.length ? (doubted ? "doubtful" : "hold") : "", doubted ? "doubt" : "fine");
    const counts = [link.used, link.lost, link.late, link.duplicate];
    return row(node, [...counts.map((n) => n.toLocaleString("en")), judged]);
  }));
}

function tests(view) {
  at("tests").replaceChildren(...view.tests.map((test) => row(test.node + "/" + test.filter, [test.claim,
    made("td", short(test.ratio, 3), test.doubt ? "doubt" : "fine"), short(test.low, 2) + " to " + short(test.high, 3)])));
}

const first = JSON.parse(at("first").textContent);
if (first.points.length) show(first);
connect();
