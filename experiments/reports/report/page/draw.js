"use strict";
// Draw the charts in the chosen theme, at first the system's; a click on the errors shows the maps of that iteration.
const text = document.getElementById("data").textContent;
const config = {
  displaylogo: false, responsive: true, doubleClick: "reset",
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
  showSendToCloud: false, plotlyServerURL: "", // no button sends the data to Plotly's server
};
const screen = matchMedia("screen"); // paper is white
const dark = matchMedia("screen and (prefers-color-scheme: dark)");
const root = document.documentElement;
const isDark = () => screen.matches && (root.dataset.theme ? root.dataset.theme === "dark" : dark.matches);
const place = (name) => document.getElementById(`chart-${name}`);
const { lighter } = JSON.parse(text);
function draw() {
  const themed = isDark() ? text.replace(/"#\w{6}"/g, (colour) => JSON.stringify(lighter[JSON.parse(colour)] || JSON.parse(colour))) : text;
  const { charts, templates } = JSON.parse(themed);
  for (const [name, { data, layout, frames }] of Object.entries(charts)) {
    layout.template = templates[isDark() ? "dark" : "light"];
    Plotly.newPlot(place(name), { data, layout, frames, config });
  }
  if (charts.errors && charts.map) place("errors").on("plotly_click", ({ points }) => {
    const frame = charts.map.frames.find(({ name }) => Number(name) === points[0].x);
    if (frame) Plotly.animate(place("map"), [frame.name], charts.map.layout.sliders[0].steps[0].args[1]);
  });
}
addEventListener("load", () => setTimeout(draw));
for (const media of [screen, dark]) media.addEventListener("change", draw);
document.getElementById("theme").addEventListener("click", () => {
  root.dataset.theme = isDark() ? "light" : "dark"; // the first click leaves the system's theme
  draw();
});
