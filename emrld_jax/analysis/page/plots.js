// Scales, line charts and interval charts.
function ticks(low, high, count) {
  const raw = (high - low) / count || 1, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((x) => x * power).find((x) => x >= raw);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) {
    found.push(k * step);
  }
  return found;
}
function scale(low, high, from, to) {
  const span = high - low || 1;
  return (value) => from + ((value - low) / span) * (to - from);
}
function range(values, pad) {
  let low = Infinity, high = -Infinity;
  for (const value of values) {
    if (value === null || value === undefined) continue;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  if (low > high) return [0, 1];
  const room = (high - low || Math.abs(high) || 1) * pad;
  return [low - room, high + room];
}
function lineOf(xs, ys, x, y) {
  let text = "", pen = "M";
  for (let k = 0; k < xs.length; k++) {
    if (ys[k] === null) { pen = "M"; continue; }
    text += `${pen}${x(xs[k]).toFixed(1)},${y(ys[k]).toFixed(1)}`;
    pen = "L";
  }
  return text;
}
function bandOf(line, x, y) {
  const there = line.x.map((_, k) => k).filter((k) => line.low[k] !== null);
  if (!there.length) return "";
  const point = (k, side) => `${x(line.x[k]).toFixed(1)},${y(line[side][k]).toFixed(1)}`;
  return `M${there.map((k) => point(k, "high")).join("L")}L`
    + `${there.reverse().map((k) => point(k, "low")).join("L")}Z`;
}
function frame(width, height, xs, ys, xWords, form, whole) {
  const left = 46, right = 12, top = 10, bottom = 40;
  const x = scale(...xs, left, width - right), y = scale(...ys, height - bottom, top);
  const node = svg("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "img" });
  for (const value of ticks(...ys, 5)) {
    node.append(svg("line", { class: "rule", x1: left, x2: width - right, y1: y(value),
      y2: y(value) }), svg("text", { x: left - 7, y: y(value) + 4, "text-anchor": "end" },
      form(value)));
  }
  for (const value of ticks(...xs, Math.max(2, Math.floor(width / 110)))) {
    if (whole && !Number.isInteger(value)) continue;
    node.append(svg("text", { x: x(value), y: height - bottom + 17, "text-anchor": "middle" },
      short(value)));
  }
  node.append(svg("line", { class: "base", x1: left, x2: width - right, y1: height - bottom,
    y2: height - bottom }), svg("text", { x: (left + width - right) / 2, y: height - 5,
    "text-anchor": "middle" }, xWords));
  return { node, x, y, left, right: width - right, top, bottom: height - bottom };
}

// lines: {label, name, color, seeds, x, value, low, high, each}; options: xWords, form, axisForm,
// ys, reference {value, name}, each (draw every seed), points (mark the values), whole (x are
// whole numbers)
function lineChart(lines, options) {
  const place = el("div", {}), legend = el("div", { class: "legend" });
  const readings = [];
  const where = el("span", { class: "value quiet" });
  const read = (pointed) => {
    const at = options.whole ? Math.round(pointed) : pointed;
    for (const [line, cell] of readings) {
      let k = 0;
      line.x.forEach((own, j) => { if (Math.abs(own - at) < Math.abs(line.x[k] - at)) k = j; });
      const own = { value: line.value[k], low: line.low[k], high: line.high[k] };
      cell.textContent = withInterval(own, options.form);
    }
    where.textContent = `at ${short(at)}`;
  };
  legend.append(el("span", {}), el("span", { class: "quiet" }, options.xWords), where);
  for (const line of lines) {
    const cell = el("span", { class: "value" });
    readings.push([line, cell]);
    legend.append(el("span", { class: "key", color: line.color }),
      el("span", {}, line.name || line.label, " ",
        el("span", { class: "quiet" }, `(${line.seeds})`)), cell);
  }
  if (options.reference) {
    legend.append(el("span", { class: "key hollow" }), el("span", {}, options.reference.name),
      el("span", { class: "value" }, options.form(options.reference.value)));
  }
  const all = lines.flatMap((line) => line.x);
  const xs = options.xs || range(all, 0);
  read(xs[1]);
  draw(place, (width) => {
    const ys = options.ys || range([...lines.flatMap((line) => [...line.value, ...line.low,
      ...line.high, ...(options.each ? line.each.flat() : [])]),
      options.reference ? options.reference.value : null, 0], 0.04);
    const chart = frame(width, options.height || 280, xs, ys, options.xWords,
      options.axisForm || short, options.whole);
    const { node, x, y } = chart;
    if (options.reference) {
      const at = y(options.reference.value);
      node.append(svg("line", { class: "reference", x1: chart.left, x2: chart.right, y1: at,
        y2: at }));
    }
    for (const line of lines) {
      node.append(svg("path", { class: "band", color: line.color, d: bandOf(line, x, y) }));
    }
    for (const line of lines) {
      for (const own of options.each ? line.each : []) {
        node.append(svg("path", { class: "seed", color: line.color,
          d: lineOf(line.x, own, x, y) }));
      }
      node.append(svg("path", { class: "curve", color: line.color,
        d: lineOf(line.x, line.value, x, y) }));
      if (options.points) {
        line.x.forEach((own, k) => {
          if (line.low[k] !== null) {
            node.append(svg("line", { class: "whisker", color: line.color, x1: x(own), x2: x(own),
              y1: y(line.low[k]), y2: y(line.high[k]) }));
          }
          node.append(svg("circle", { class: "dot", color: line.color, cx: x(own),
            cy: y(line.value[k]), r: 4 }));
        });
      }
    }
    const cursor = svg("line", { class: "cursor", y1: chart.top, y2: chart.bottom,
      visibility: "hidden" });
    node.append(cursor);
    node.addEventListener("pointermove", (event) => {
      const inside = (event.clientX - node.getBoundingClientRect().left - chart.left)
        / (chart.right - chart.left);
      const at = xs[0] + Math.min(1, Math.max(0, inside)) * (xs[1] - xs[0]);
      cursor.setAttribute("x1", x(at));
      cursor.setAttribute("x2", x(at));
      cursor.setAttribute("visibility", "visible");
      read(at);
    });
    node.addEventListener("pointerleave", () => {
      cursor.setAttribute("visibility", "hidden");
      read(xs[1]);
    });
    return node;
  });
  return el("div", { class: "figure" }, place, legend);
}

// rows: {label, color, note, value, low, high}; one interval each, on a common scale
function intervalChart(rows, xs, options) {
  const place = el("div", {});
  draw(place, (width) => {
    const pitch = 46, height = rows.length * pitch + 34, x = scale(...xs, 18, width - 18);
    const node = svg("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "img" });
    for (const value of ticks(...xs, 4)) {
      node.append(svg("line", { class: "rule", x1: x(value), x2: x(value), y1: 4,
        y2: height - 22 }), svg("text", { x: x(value), y: height - 6, "text-anchor": "middle" },
        options.form(value)));
    }
    if (options.middle !== undefined) {
      node.append(svg("line", { class: "reference", x1: x(options.middle), x2: x(options.middle),
        y1: 4, y2: height - 22 }));
    }
    rows.forEach((row, k) => {
      const top = k * pitch + 18, at = top + 16;
      node.append(svg("text", { x: 8, y: top, style: "fill: var(--ink)" }, row.label,
        svg("tspan", { dx: 8, style: "fill: var(--quiet)" },
          `${withInterval(row, options.form)}  ${row.note}`)));
      if (row.low !== null) {
        node.append(svg("line", { class: "whisker", color: row.color, x1: x(row.low),
          x2: x(row.high), y1: at, y2: at }));
      }
      node.append(svg("circle", { class: "dot", color: row.color, cx: x(row.value), cy: at,
        r: 5 }));
    });
    return node;
  });
  return el("div", { class: "figure" }, place);
}
