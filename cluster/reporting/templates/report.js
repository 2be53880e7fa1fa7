"use strict";
// Draws the figures of the page. Those in three dimensions exist only while they are in view, since a browser keeps no
// more than about sixteen drawing contexts alive; the clouds of one figure turn together.

// Turning the wheel scrolls the page; to come nearer, one drags after a click on the magnifying glass.
const CONFIG = { responsive: true, displaylogo: false, scrollZoom: false };
const FLAT = { ...CONFIG, displayModeBar: false };
const SOLID = { ...CONFIG, displayModeBar: true, modeBarButtons: [["zoom3d", "pan3d", "orbitRotation", "resetCameraDefault3d", "toImage"]] };

function draw(node) {
  if (node.dataset.drawn) return;
  node.dataset.drawn = "yes";
  const figure = JSON.parse(document.getElementById(node.dataset.figure).textContent);
  if (node.camera) for (const name of scenes(figure.layout)) figure.layout[name].camera = node.camera;
  const solid = node.classList.contains("solid");
  Plotly.newPlot(node, figure.data, figure.layout, solid ? SOLID : FLAT)
    .then(() => { if (solid) node.on("plotly_relayout", (event) => turnTogether(node, event)); })
    .catch((error) => { node.classList.add("failed"); node.textContent = "This figure cannot be drawn here: " + error; });
}

function scenes(layout) {
  return Object.keys(layout).filter((name) => /^scene\d*$/.test(name));
}

function turnTogether(node, event) {
  const turned = Object.keys(event).find((name) => name.endsWith(".camera"));
  if (!turned || node.turning) return;
  node.camera = event[turned];
  node.turning = true; // What follows is such an event again.
  Plotly.relayout(node, Object.fromEntries(scenes(node.layout).map((name) => [name + ".camera", node.camera])))
    .then(() => { node.turning = false; });
}

const watch = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    if (isIntersecting) draw(target);
    else if (target.dataset.drawn && target.classList.contains("solid")) {
      Plotly.purge(target);
      delete target.dataset.drawn;
    }
  }
}, { rootMargin: "100px" });
for (const node of document.querySelectorAll(".plot")) watch.observe(node);

for (const button of document.querySelectorAll(".tabs button")) {
  button.addEventListener("click", () => {
    const { section, tab } = button.dataset;
    for (const other of button.parentElement.children) other.classList.toggle("chosen", other === button);
    for (const figure of document.querySelectorAll(`figure[data-of="${section}"]`)) figure.hidden = figure.dataset.place !== tab;
  });
}
