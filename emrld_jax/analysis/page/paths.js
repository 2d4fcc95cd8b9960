// Where episodes went: before and after adaptation, along the meta-iterations.
const ENDED = -32768;
function bytes(text) { return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)); }
const UNPACKED = new Map();
function unpacked(kept) {  // unpacked when it is looked at
  if (!UNPACKED.has(kept)) {
    const whole = (text) => new Int16Array(bytes(text).buffer);
    UNPACKED.set(kept, { path: whole(kept.path), demo: whole(kept.demo),
      rewarded: bytes(kept.rewarded) });
  }
  return UNPACKED.get(kept);
}
function pointsOf(numbers, start, count, step) {
  const points = [];
  for (let k = start; k < start + count; k++) {
    if (numbers[2 * k] === ENDED) break;
    points.push([numbers[2 * k] * step, numbers[2 * k + 1] * step]);
  }
  return points;
}
// each task's demonstration, aim and episodes {points, rewarded} of stage 0 or 1
function tasksOf(kept, stage) {
  const { path, demo, rewarded } = unpacked(kept), [episodes, count] = kept.shape;
  return kept.tasks.map((number, task) => ({
    number, aim: kept.aims[task],
    demo: pointsOf(demo, task * kept.demoPoints, kept.demoPoints, kept.scale),
    returns: kept.returns[task][stage],
    episodes: Array.from({ length: episodes }, (_, episode) => {
      const place = (task * 2 + stage) * episodes + episode;
      const start = place * (count - 1);
      return { points: pointsOf(path, place * count, count, kept.scale),
        rewarded: rewarded.subarray(start, start + count - 1) };
    }),
  }));
}
function taskColor(kind, task, share) {
  if (kind === "runner") return task.aim[0] > 0 ? "var(--s0)" : "var(--s1)";
  return `hsl(${Math.round(215 - 250 * share)} 70% 50%)`;
}
function viewOf(run) {  // the same for all moments, so that paths can be followed
  const parts = [...run.frames, ...Object.values(run.final)];
  const xs = [], ys = [];
  for (const kept of parts) {
    for (const task of tasksOf(kept, 1)) {
      for (const [x, y] of task.demo) { xs.push(x); ys.push(y); }
      if (run.kind === "plane") {
        xs.push(task.aim[0] - run.zone, task.aim[0] + run.zone);
        ys.push(task.aim[1] - run.zone, task.aim[1] + run.zone);
      } else {
        for (const { points } of task.episodes) {
          for (const [x, y] of points) { xs.push(x); ys.push(y); }
        }
      }
    }
  }
  if (run.kind === "runner") ys.push(-1.5 * run.zone, 1.5 * run.zone);
  return { xs: range(xs, run.kind === "plane" ? 0.07 : 0), ys: range(ys, 0.07) };
}
function runsOf(task, x, y) {  // rewarded steps, as the pieces of path that they make
  let text = "";
  for (const { points, rewarded } of task.episodes) {
    for (let k = 0; k < points.length; k++) {
      if (!rewarded[k]) continue;
      const from = points[k], to = points[k + 1] || from;
      text += `M${x(from[0]).toFixed(1)},${y(from[1]).toFixed(1)}`
        + `L${(x(to[0]) + (to === from ? 0.1 : 0)).toFixed(1)},${y(to[1]).toFixed(1)}`;
    }
  }
  return text;
}
function pathText(points, x, y) {
  return points.length ? `M${points.map(([a, b]) => `${x(a).toFixed(1)},${y(b).toFixed(1)}`)
    .join("L")}` : "";
}
function zonesOf(run, tasks, view, chart) {
  const { x, y } = chart, made = [];
  if (run.kind === "runner") {
    for (const [low, high] of [[run.zone, view.ys[1]], [view.ys[0], -run.zone]]) {
      made.push(svg("rect", { class: "zone", x: chart.left, width: chart.right - chart.left,
        y: y(high), height: Math.max(0, y(low) - y(high)) }));
    }
    return made;
  }
  const same = tasks.every((task) => task.aim.join() === tasks[0].aim.join());
  (same ? tasks.slice(0, 1) : tasks).forEach((task) => {
    const color = same ? "var(--zone)" : task.color;
    made.push(svg("circle", { class: "zone", color, cx: x(task.aim[0]), cy: y(task.aim[1]),
      r: Math.abs(x(run.zone) - x(0)) }), svg("circle", { class: "goal", color,
      cx: x(task.aim[0]), cy: y(task.aim[1]), r: 3 }));
  });
  return made;
}
function pathPanel(run, kept, stage, view, words) {
  const tasks = tasksOf(kept, stage);
  const last = Math.max(1, tasks.length - 1);
  tasks.forEach((task, k) => { task.color = taskColor(run.kind, task, k / last); });
  const all = tasks.flatMap((task) => task.returns);
  const mean = all.reduce((sum, value) => sum + value, 0) / Math.max(1, all.length);
  const found = tasks.filter((task) => task.returns.some((value) => value > 0)).length;
  const place = el("div", {});
  draw(place, (width) => {
    const wide = view.xs[1] - view.xs[0], tall = view.ys[1] - view.ys[0];
    const inner = width - 58;
    const height = run.kind === "plane" ? Math.min(560, inner * tall / wide) + 50 : 300;
    // equal lengths on both axes, also where the height is bounded
    const extra = run.kind === "plane" ? (inner / ((height - 50) / tall) - wide) / 2 : 0;
    const xs = [view.xs[0] - extra, view.xs[1] + extra];
    const chart = frame(width, height, xs, view.ys, run.kind === "plane" ? "x (m), y (m) upward"
      : "time (s); way from the start (m) upward", short);
    const { node, x, y } = chart, id = `clip${Math.random().toString(36).slice(2)}`;
    const inside = svg("g", { "clip-path": `url(#${id})` });
    node.append(svg("clipPath", { id }, svg("rect", { x: chart.left, y: chart.top,
      width: chart.right - chart.left, height: chart.bottom - chart.top })), inside);
    inside.append(...zonesOf(run, tasks, view, chart));
    for (const task of tasks) {
      inside.append(svg("path", { class: "paid", color: task.color, d: runsOf(task, x, y) }));
      for (const { points } of task.episodes) {
        inside.append(svg("path", { class: "path", color: task.color,
          d: pathText(points, x, y) }));
        const end = points[points.length - 1];
        if (end) inside.append(svg("circle", { class: "dot", color: task.color, r: 2.2,
          cx: x(end[0]), cy: y(end[1]) }));
      }
    }
    for (const task of tasks) {
      inside.append(svg("path", { class: "demo", d: pathText(task.demo, x, y) }));
    }
    return node;
  });
  return el("div", { class: "figure" }, el("h3", {}, words), el("p", { class: "quiet small" },
    `return of what is drawn ${mean.toFixed(1)}; reward found in ${found} of ${tasks.length} `
    + `task${tasks.length === 1 ? "" : "s"}`), place);
}

function pathsSection() {
  const about = "Dashed: demonstrations. Colored: episodes of tasks; where they are thick, the "
    + "policy was rewarded. Shaded: where reward can be found.";
  if (!DATA.drawn.length) {
    section("paths", "Trajectories", "", el("p", { class: "quiet" }, "These runs kept no episodes: "
      + "runs of earlier versions did not, and some environments cannot be drawn."));
    return;
  }
  let run = DATA.drawn[0], split = "test", playing = null;
  const moments = el("div", {}), ends = el("div", { class: "grid", id: "final-paths" });
  const splits = el("span", {});
  const views = new Map();
  const viewed = () => {
    if (!views.has(run)) views.set(run, viewOf(run));
    return views.get(run);
  };
  const showEnd = () => {
    const kept = run.final[split];
    ends.replaceChildren(...(kept ? [0, 1].map((stage) => pathPanel(run, kept, stage, viewed(),
      `${SPLIT_WORDS[split]}, ${stage ? "after" : "before"} adaptation`))
      : [el("p", { class: "quiet" }, "This run kept none.")]));
    for (const place of ends.querySelectorAll("div.figure > div")) redraw(place);
  };
  const show = () => {
    clearInterval(playing);
    const slider = el("input", { type: "range", id: "moment", min: 0, step: 1,
      max: Math.max(0, run.frames.length - 1), "aria-label": "meta-iteration" });
    slider.value = run.frames.length - 1;
    const words = el("output", { for: "moment", id: "moment-words" });
    const panels = el("div", { class: "grid", id: "moment-paths" });
    const at = () => {
      const kept = run.frames[Number(slider.value)];
      words.textContent = kept.iteration ? `meta-iteration ${kept.iteration}` : "before training";
      panels.replaceChildren(...[0, 1].map((stage) => pathPanel(run, kept, stage, viewed(),
        `${SPLIT_WORDS.train}, ${stage ? "after" : "before"} adaptation`)));
      for (const place of panels.querySelectorAll("div.figure > div")) redraw(place);
    };
    const play = el("button", { type: "button", id: "play", onclick: () => {
      if (playing !== null) { stop(); return; }
      if (Number(slider.value) === run.frames.length - 1) slider.value = 0;
      play.textContent = "pause";
      at();
      playing = setInterval(() => {
        slider.value = Number(slider.value) + 1;
        at();
        if (Number(slider.value) >= run.frames.length - 1) stop();
      }, 450);
    } }, "play");
    const stop = () => { clearInterval(playing); playing = null; play.textContent = "play"; };
    stop();
    slider.addEventListener("input", () => { stop(); at(); });
    moments.replaceChildren(el("div", { class: "slider" }, play, slider, words), panels);
    if (run.frames.length) at();
    else moments.replaceChildren(el("p", { class: "quiet" }, "Nothing was kept as it trained."));
    const there = ["test", "train"].filter((name) => run.final[name]);
    if (there.length && !there.includes(split)) split = there[0];
    splits.replaceChildren(there.length ? choices("final-split", "of", there.map((name) =>
      [name, SPLIT_WORDS[name]]), split, (value) => { split = value; showEnd(); }) : "");
    document.getElementById("path-words").textContent = run.kind === "runner"
      ? `Blue should run forward, orange backward; reward beyond ${run.zone} m from the start.`
      : `The reward zone reaches ${run.zone} m from the goal.`;
    showEnd();
  };
  const options = DATA.drawn.map((own, k) => {
    const group = DATA.groups[own.group];
    return [String(k), `${problemOf(group)}: ${group.label}, seed ${own.seed}`];
  });
  section("paths", "Trajectories", `${about} Of each line, at most ${DATA.runsDrawn} seeds can be `
    + "chosen.", el("div", { class: "controls" }, list("drawn-run", "run", options,
      (value) => { run = DATA.drawn[Number(value)]; show(); })),
    el("p", { class: "quiet small", id: "path-words" }),
    el("h3", {}, "As training went on"), moments,
    el("h3", { style: "margin-top: 1.4rem" }, "In the final evaluation"),
    el("div", { class: "controls" }, splits), ends);
  show();
}
function redraw(place) {
  for (const old of [...DRAWN.keys()]) if (!old.isConnected) DRAWN.delete(old);
  if (DRAWN.has(place)) draw(place, DRAWN.get(place));
}
