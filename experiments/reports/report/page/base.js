"use strict";
// What the charts and the map share: the data, the theme, and which methods are shown.

const DATA = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const BUS = new EventTarget(); // "theme", "methods", "iteration" (detail: {iteration, from})
const hidden = new Set();
const styleOf = new Map(DATA.aligners.map((aligner) => [aligner.name, aligner]));

function tell(what, detail) {
  BUS.dispatchEvent(new CustomEvent(what, { detail }));
}

/** A colour of the page's theme by name. */
function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** The same with an opacity, for canvases and charts. */
function faint(name, opacity) {
  const hex = colour(name);
  const part = (i) => parseInt(hex.slice(i, i + 2), 16);
  return `rgba(${part(1)}, ${part(3)}, ${part(5)}, ${opacity})`;
}

/** A number with about three digits that count. */
function short(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const digits = Math.max(0, 2 - Math.floor(Math.log10(Math.abs(value))));
  return value.toFixed(Math.min(digits, 5));
}

/** An element with text; text is never taken for HTML. */
function element(tag, attributes = {}, text = "") {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text) made.textContent = text;
  return made;
}

function drawing(tag, attributes) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

function swatch(style) {
  const svg = drawing("svg", { viewBox: "0 0 26 10", class: "swatch", "aria-hidden": "true" });
  const dash = style.dash === "solid" ? "none" : style.dash.replaceAll("px", "");
  svg.append(
    drawing("line", {
      x1: 1, y1: 5, x2: 25, y2: 5,
      stroke: `var(--${style.colour})`, "stroke-width": 2.4, "stroke-dasharray": dash,
    }),
  );
  return svg;
}

function fillSelect(select, labels) {
  labels.forEach((label, place) => select.append(element("option", { value: place }, label)));
  const field = select.closest(".field");
  if (field) field.hidden = labels.length < 2;
}

/** Two buttons of which one is pressed; tells the pressed one's name. */
function segments(buttons, onChange) {
  for (const [name, button] of Object.entries(buttons)) {
    button.addEventListener("click", () => {
      for (const other of Object.values(buttons)) {
        other.setAttribute("aria-pressed", String(other === button));
      }
      onChange(name);
    });
  }
}

for (const aligner of DATA.aligners) {
  const chip = element("button", { type: "button", class: "chip", "aria-pressed": "true" });
  chip.append(swatch(aligner), aligner.name);
  chip.addEventListener("click", () => {
    const show = hidden.has(aligner.name);
    if (show) hidden.delete(aligner.name);
    else hidden.add(aligner.name);
    chip.setAttribute("aria-pressed", String(show));
    tell("methods");
  });
  byId("chips").append(chip);
}

// Theme: as the system has it until the button says otherwise.
const themes = ["auto", "light", "dark"];
let theme = 0;
byId("theme").addEventListener("click", () => {
  theme = (theme + 1) % themes.length;
  if (theme === 0) delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = themes[theme];
  byId("theme").textContent = theme === 0 ? "Theme" : `Theme: ${themes[theme]}`;
  tell("theme");
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => tell("theme"));
matchMedia("print").addEventListener("change", () => tell("theme")); // paper is white

// Plotly takes the browser longer than all the rest: it is read once the page is there.
addEventListener("load", () => setTimeout(() => {
  for (const id of ["plotly", "charts"]) {
    const script = document.createElement("script");
    script.textContent = byId(id).textContent;
    document.head.append(script);
  }
}));
