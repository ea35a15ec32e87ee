"use strict";
(() => {
  const PANELS = 12, CURVES = 120, ROWS = 200, LOGARITHMIC = 8;  // more than that is not drawn, and the page says so
  const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#b05c92", "#e69f00", "#66727f"];
  const DASHES = ["solid", "dashed", "dotted"];
  const tables = JSON.parse(document.getElementById("data").textContent);
  const at = id => document.getElementById(id);
  const show = value => value === null ? "–" : typeof value === "number" ? String(Number(value.toPrecision(4))) : String(value);
  const plain = value => show(value).replace(/\$\$|\\[[(]/g, found => found[0] + "\u200b" + found[1]);  // no formula
  const make = (name, text = "") => { const made = document.createElement(name); made.textContent = text; return made; };
  const parted = name => name.replaceAll("_", "_\u200b");  // where a line may end
  let data, columns, dimensions, size, values, chosen, sorted;  // of the table that is looked at
  const numeric = name => values[name].every(value => typeof value === "number");
  let views = null, wanted = 0, drawing = Promise.resolve();

  function use(table) {
    data = table;
    ({columns, dimensions} = data);
    size = columns[dimensions[0]].length;
    values = Object.fromEntries(dimensions.map(name => {
      const found = [...new Set(columns[name])];
      return [name, found.every(value => typeof value === "number") ? found.sort((a, b) => a - b) : found];
    }));
    chosen = Object.fromEntries(dimensions.map(name =>
      [name, new Set(data.whole.includes(name) ? values[name] : values[name].slice(0, 1))]));
    sorted = {name: null, down: false};
    const ordered = dimensions.filter(name => name !== data.unordered);
    options("y", data.quantities.map(item => item.name), data.quantities.map(item => item.label), data.quantities[0].name);
    options("x", dimensions, dimensions, data.x);
    options("panel", ["", ...ordered], ["nothing", ...ordered], data.panel);
    options("colour", ordered, ordered, data.colour);
    scales();
    boxes();
    draw();
  }

  function options(id, names, labels, first) {
    at(id).replaceChildren(...names.map((name, i) => new Option(labels[i], name, name === first, name === first)));
    at(id).dataset.was = first;
  }

  // What is along an axis, in panels or colours is wanted whole; a long axis that is left, at its end alone.
  function widen(id) {
    const name = at(id).value, {was} = at(id).dataset;
    at(id).dataset.was = name;
    if (name && chosen[name].size < 2) chosen[name] = new Set(values[name]);
    if (was && free(was) && values[was].length > PANELS) chosen[was] = new Set(values[was].slice(-1));
    if (name === data.unordered) dimensions.filter(free).forEach(other => chosen[other] = new Set(values[other]));
  }
  const free = name => ![at("x").value, at("panel").value, at("colour").value].includes(name);

  function style(name, value) {
    const i = values[name].indexOf(value);
    return {color: COLOURS[i % COLOURS.length], dash: DASHES[Math.floor(i / COLOURS.length) % DASHES.length]};
  }

  function boxes() {
    at("values").replaceChildren(...dimensions.filter(name => name !== data.unordered && values[name].length > 1).map(name => {
      const field = make("fieldset");
      const legend = make("legend"), all = make("button", name);
      all.type = "button";
      all.title = "all, or the first alone";
      all.addEventListener("click", () => {
        chosen[name] = new Set(chosen[name].size < values[name].length ? values[name] : values[name].slice(0, 1));
        boxes();
        draw();
      });
      legend.append(all);
      field.append(legend);
      for (const value of values[name]) {
        const label = make("label"), box = make("input");
        box.type = "checkbox";
        box.checked = chosen[name].has(value);
        box.addEventListener("change", () => { chosen[name][box.checked ? "add" : "delete"](value); draw(); });
        label.append(box, " ");
        if (name === at("colour").value) {
          const dot = make("span");
          dot.className = "dot";
          dot.style.setProperty("--c", style(name, value).color);
          label.append(dot);
        }
        label.append(show(value));
        field.append(label);
      }
      return field;
    }));
  }

  // Far apart, and rather by equal factors than by equal steps.
  function wide(found) {
    const low = found[0], high = found[found.length - 1], middle = found[Math.floor(found.length / 2)];
    const off = place => Math.abs(Math.log(middle / place));
    return found.length > 2 && low > 0 && high > LOGARITHMIC * low && off(Math.sqrt(low * high)) < off((low + high) / 2);
  }
  function scales() {
    const y = columns[at("y").value].filter(value => value !== null), x = at("x").value;
    at("logy").checked = y.length > 2 && y.every(v => v > 0) && y.reduce((a, b) => Math.max(a, b)) > LOGARITHMIC * y.reduce((a, b) => Math.min(a, b));
    at("logx").disabled = !numeric(x) || values[x][0] <= 0;
    at("logx").checked = !at("logx").disabled && x !== data.unordered && wide(values[x]);
  }

  function selected() {
    const rows = [];
    for (let i = 0; i < size; i++) if (dimensions.every(name => chosen[name].has(columns[name][i]))) rows.push(i);
    return rows;
  }

  function grouped(rows, key) {
    const groups = new Map();
    for (const i of rows) {
      const name = key(i);
      groups.has(name) ? groups.get(name).push(i) : groups.set(name, [i]);
    }
    return [...groups.values()];
  }

  function draw() {
    const rows = selected(), panel = at("panel").value, x = at("x").value;
    const others = dimensions.filter(name => name !== x && (x === data.unordered ? data.whole.includes(name) : name !== data.unordered));
    const panels = grouped(rows, i => panel ? show(columns[panel][i]) : "");
    const curves = panels.slice(0, PANELS).map(part => grouped(part, i => JSON.stringify(others.map(name => columns[name][i]))));
    const there = panels.reduce((sum, part) => sum + grouped(part, i => JSON.stringify(others.map(name => columns[name][i]))).length, 0);
    let left = CURVES;
    const drawn = curves.map(part => { const shown = part.slice(0, left); left -= shown.length; return shown; }).filter(part => part.length);
    const count = drawn.reduce((sum, part) => sum + part.length, 0);
    at("shown").textContent = !rows.length ? "Nothing is chosen: tick a value in every list." :
      (count < there ? `${drawn.length} of ${panels.length} panels and ${count} of ${there} curves are shown; choose fewer values to see the others.` :
        `${count} curve${count === 1 ? "" : "s"} in ${drawn.length} panel${drawn.length === 1 ? "" : "s"}.`) +
      " Bars: two standard errors to both sides. Drag to move, box to zoom, point to read.";
    table(rows);
    const turn = ++wanted;  // what is no longer wanted when its turn comes is not drawn
    drawing = drawing.then(() => turn === wanted ? paint(drawn, others) : null).catch(error => console.error(error));
  }

  async function paint(parts, others) {
    views?.clear();
    at("panels").replaceChildren();
    const shared = ranges(parts.flat(2)), drawing = new Bokeh.Document();
    const places = parts.map(curves => {
      const box = make("div"), place = make("div"), panel = at("panel").value;
      place.className = "plot";
      if (panel) box.append(make("h3", `${panel}: ${show(columns[panel][curves[0][0]])}`));
      box.append(place);
      at("panels").append(box);
      drawing.add_root(figure(curves, others, shared));
      return place;
    });
    views = await Bokeh.embed.add_document_standalone(drawing, document.body, places);
    document.documentElement.dataset.drawn = String(Number(document.documentElement.dataset.drawn || 0) + 1);
  }

  const across = i => { const x = at("x").value; return numeric(x) ? columns[x][i] : values[x].indexOf(columns[x][i]); };
  const quantity = () => data.quantities.find(item => item.name === at("y").value);

  // One range for all panels, so that they compare and zoom together.
  function ranges(rows) {
    const {name, error, level} = quantity();
    const found = rows.filter(i => columns[name][i] !== null);
    const ends = [-2, 2].flatMap(times => found.map(i => columns[name][i] + times * (columns[error]?.[i] ?? 0)));
    const y = [...ends, ...found.map(i => columns[name][i]), ...(level === null ? [] : [level])];
    return {
      x_range: range(rows.map(across), at("logx").checked),
      y_range: range(at("logy").checked ? y.filter(value => value > 0) : y, at("logy").checked),
    };
  }
  function range(found, logarithmic) {
    let low = Infinity, high = -Infinity;
    for (const value of found) { low = Math.min(low, value); high = Math.max(high, value); }
    if (low > high) [low, high] = [1, 2];
    if (logarithmic) { const more = Math.max((high / low) ** 0.08, 1.02); return new Bokeh.Range1d({start: low / more, end: high * more}); }
    const more = (high - low) * 0.08 || Math.abs(high) * 0.1 || 1;
    return new Bokeh.Range1d({start: low - more, end: high + more});
  }

  function figure(curves, others, shared) {
    const x = at("x").value, {name, label, error, level} = quantity();
    const plot = Bokeh.Plotting.figure({
      ...shared, tools: "pan,box_zoom,wheel_zoom,reset,save", sizing_mode: "stretch_both", output_backend: "svg",
      x_axis_type: at("logx").checked ? "log" : "linear", y_axis_type: at("logy").checked ? "log" : "linear",
      x_axis_label: plain(x), y_axis_label: label,
    });
    plot.toolbar.logo = null;
    if (matchMedia("(pointer: coarse)").matches) plot.toolbar.active_drag = null;  // a finger scrolls the page
    plot.toolbar.autohide = true;
    if (!numeric(x)) {
      plot.xaxis.ticker = new Bokeh.FixedTicker({ticks: values[x].map((_, i) => i)});
      plot.xaxis.major_label_overrides = new Map(values[x].map((value, i) => [i, plain(value)]));
    }
    if (level !== null) plot.add_layout(new Bokeh.Span({location: level, dimension: "width", line_color: "#1f2933", line_dash: "dashed"}));
    const tips = [x, ...others.filter(other => values[other].length > 1), label, "finite runs"];
    const points = [];
    for (const rows of curves) {
      const sorted = rows.filter(i => columns[name][i] !== null).sort((a, b) => across(a) - across(b));
      const y = sorted.map(i => columns[name][i]), half = sorted.map(i => 2 * (columns[error]?.[i] ?? 0));
      const floor = at("logy").checked ? (value, i) => Math.max(value, y[i] / 1e3) : value => value;
      const shown = {x: sorted.map(across), y, low: y.map((value, i) => floor(value - half[i], i)), high: y.map((value, i) => value + half[i])};
      tips.forEach((tip, j) => shown[`tip${j}`] = sorted.map(i => tip === label ? show(columns[name][i]) + (error ? ` ± ${show(columns[error][i])}` : "") :
        tip === "finite runs" ? show(columns.finite_runs[i]) : show(columns[tip][i])));
      const source = new Bokeh.ColumnDataSource({data: shown}), {color, dash} = style(at("colour").value, columns[at("colour").value][rows[0]]);
      plot.segment({field: "x"}, {field: "low"}, {field: "x"}, {field: "high"}, {source, line_color: color});
      if (numeric(x) && x !== data.unordered) plot.line({field: "x"}, {field: "y"}, {source, line_color: color, line_dash: dash, line_width: 1.6});
      points.push(plot.scatter({field: "x"}, {field: "y"}, {source, size: 7, color, marker: "circle"}));
    }
    plot.add_tools(new Bokeh.HoverTool({renderers: points, tooltips: tips.map((tip, j) => [tip, `@tip${j}`])}));
    return plot;
  }

  function table(rows) {
    const names = Object.keys(columns);
    at("heads").replaceChildren(...names.map(name => {
      const head = make("th"), button = make("button", parted(name) + (sorted.name === name ? (sorted.down ? " ▾" : " ▴") : ""));
      button.type = "button";
      button.addEventListener("click", () => { sorted = {name, down: sorted.name === name && !sorted.down}; table(selected()); });
      head.append(button);
      return head;
    }));
    if (sorted.name) {
      const column = columns[sorted.name], sign = sorted.down ? -1 : 1;
      rows = [...rows].sort((a, b) => column[a] === null ? 1 : column[b] === null ? -1 : sign * (column[a] < column[b] ? -1 : column[a] > column[b] ? 1 : 0));
    }
    at("rows").textContent = (rows.length > ROWS ? `The first ${ROWS} of ` : "") + `${rows.length} rows, of ${size} altogether. A header sorts.`;
    at("cells").replaceChildren(...rows.slice(0, ROWS).map(i => {
      const line = make("tr");
      line.append(...names.map(name => make("td", show(columns[name][i]))));
      return line;
    }));
  }

  options("table", tables.map((_, i) => String(i)), tables.map(item => item.name), "0");
  at("table").parentElement.hidden = tables.length < 2;
  at("table").addEventListener("change", () => use(tables[at("table").value]));
  for (const id of ["x", "y", "panel", "colour"])
    at(id).addEventListener("change", () => { if (id !== "y") widen(id); scales(); boxes(); draw(); });
  for (const id of ["logx", "logy"]) at(id).addEventListener("change", draw);
  at("again").addEventListener("click", draw);
  at("explore").hidden = false;
  document.documentElement.classList.add("drawn");
  use(tables[0]);
})();
