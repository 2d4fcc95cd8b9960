"use strict";
const DATA = JSON.parse(document.getElementById("data").textContent);
const SPLIT_WORDS = { train: "training tasks", test: "held-out tasks" };
const AXIS_WORDS = { iterations: "meta-iterations", env_steps: "environment steps",
  seconds: "seconds" };
const SVG = "http://www.w3.org/2000/svg";

// texts from files only ever become text nodes and attributes, never markup
function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes || {})) {
    if (name === "color") node.style.setProperty("--c", value);
    else if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value !== null && value !== false) node.setAttribute(name, value);
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return node;
}
const el = (tag, attributes, ...children) =>
  fill(document.createElement(tag), attributes, children);
const svg = (tag, attributes, ...children) =>
  fill(document.createElementNS(SVG, tag), attributes, children);

const LABELS = [...new Set(DATA.groups.map((group) => group.label))];
const PROBLEMS = [...new Set(DATA.groups.flatMap((group) => group.problems))];
function problemOf(group) { return `${group.environment}, ${group.demonstrations}`; }
function colorOf(label) {
  const number = LABELS.indexOf(label);
  return number >= 0 && number < 8 ? `var(--s${number})` : "var(--other)";
}

const isNumber = (value) => typeof value === "number";
function short(value) {  // of any size, for axes and readings
  if (value === null || value === undefined) return "\u2013";
  const size = Math.abs(value);
  if (size >= 1e9) return `${+(value / 1e9).toPrecision(3)} G`;
  if (size >= 1e6) return `${+(value / 1e6).toPrecision(3)} M`;
  if (size >= 1e4) return `${+(value / 1e3).toPrecision(3)} k`;
  return String(+value.toPrecision(size >= 100 ? 4 : 3));
}
const percent = (value) => `${Math.round(100 * value)}%`;
const formOf = (measure) => (measure === "success" ? percent : (value) => value.toFixed(1));
function withInterval(cell, form) {
  if (!cell || cell.value === null) return "\u2013";
  return cell.low === null ? form(cell.value)
    : `${form(cell.value)} [${form(cell.low)}, ${form(cell.high)}]`;
}
function duration(seconds) {
  if (seconds < 120) return `${seconds.toFixed(0)} s`;
  return seconds < 7200 ? `${(seconds / 60).toFixed(1)} min` : `${(seconds / 3600).toFixed(1)} h`;
}
const seedsText = (count) => `${count} seed${count === 1 ? "" : "s"}`;

// controls: a row of buttons, one of which is pressed; a list; a box to tick
function choices(id, words, options, current, changed) {
  const buttons = options.map(([value, text]) => el("button", {
    type: "button", "data-value": value, "aria-pressed": String(value === current),
    onclick: () => {
      for (const each of buttons) {
        each.setAttribute("aria-pressed", String(each.dataset.value === value));
      }
      changed(value);
    },
  }, text));
  return el("div", { class: "control", id, role: "group", "aria-label": words },
    el("span", {}, words), el("span", { class: "choices" }, buttons));
}
function list(id, words, options, changed) {
  const select = el("select", { id, onchange: () => changed(select.value) },
    options.map(([value, text]) => el("option", { value }, text)));
  return el("label", { class: "control" }, words, select);
}
function tick(id, words, checked, changed) {
  const box = el("input", { id, type: "checkbox", onchange: () => changed(box.checked) });
  box.checked = checked;
  return el("label", { class: "control" }, box, words);
}

const SECTIONS = [];
function section(id, title, about, ...children) {
  SECTIONS.push([id, title]);
  const node = el("section", { id }, el("h2", {}, title),
    about ? el("p", { class: "quiet small" }, about) : null, ...children);
  document.getElementById("main").append(node);
  return node;
}

// what is drawn for its place's width is drawn again when that changes
const DRAWN = new Map();
function draw(place, make) {
  DRAWN.set(place, make);
  place.replaceChildren(make(Math.max(240, place.clientWidth)));
}
let lastWidth = window.innerWidth;
window.addEventListener("resize", () => {
  if (window.innerWidth === lastWidth) return;
  lastWidth = window.innerWidth;
  for (const [place, make] of DRAWN) {
    if (place.isConnected) draw(place, make); else DRAWN.delete(place);
  }
});
