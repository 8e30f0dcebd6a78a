// Frames before and after: a slider over the chosen frame, and the thumbnails that choose it.
"use strict";
document.documentElement.classList.add("js");
for (const compare of document.querySelectorAll(".compare")) {
  const under = compare.querySelector(".under"), over = compare.querySelector(".over"), stage = compare.querySelector(".stage");
  const range = compare.querySelector("input[type=range]"), name = compare.querySelector(".name");
  const tag = compare.querySelector(".tag.right"), bar = compare.parentElement.querySelector(".depth-scale");
  const frames = [...compare.parentElement.querySelectorAll(".frame")];
  let chosen = frames[0];

  const show = () => {
    const kind = compare.querySelector("input[type=radio]:checked");
    const before = chosen.querySelector("[data-kind=raw]"), after = chosen.querySelector(`[data-kind=${kind.value}]`);
    over.src = before.src;
    over.alt = before.alt;
    under.src = (after || before).src;
    under.alt = (after || before).alt;
    tag.textContent = after ? kind.dataset.tag : "not available for this frame";
    if (bar) bar.hidden = kind.value !== "depth";
    name.textContent = chosen.dataset.caption;
    for (const frame of frames) frame.querySelector("button").setAttribute("aria-pressed", String(frame === chosen));
  };
  const slide = () => stage.style.setProperty("--at", `${range.value}%`);
  range.addEventListener("input", slide);
  for (const radio of compare.querySelectorAll("input[type=radio]")) radio.addEventListener("change", show);
  for (const frame of frames) frame.querySelector("button").addEventListener("click", () => { chosen = frame; show(); });
  slide();
  show();
}
