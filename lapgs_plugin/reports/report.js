// Show two pictures of a view on top of each other, with a divider to drag or to move with the arrow keys.
"use strict";
for (const strip of document.querySelectorAll(".strip")) {
  const pictures = [...strip.querySelectorAll(".zoom img")];
  const compare = strip.querySelector(".compare");
  const pair = strip.querySelector(".pair");
  const divider = strip.querySelector(".divider");

  const place = (percent) => {
    const at = Math.min(100, Math.max(0, percent));
    pair.style.setProperty("--at", `${at}%`);
    divider.setAttribute("aria-valuenow", Math.round(at));
  };
  const follow = (event) => {
    const box = pair.getBoundingClientRect();
    place((100 * (event.clientX - box.left)) / box.width);
  };
  pair.addEventListener("pointerdown", (event) => {
    event.preventDefault();  // do not drag the pictures themselves
    divider.focus({ preventScroll: true });
    pair.setPointerCapture(event.pointerId);
    follow(event);
  });
  pair.addEventListener("pointermove", (event) => {
    if (pair.hasPointerCapture(event.pointerId)) follow(event);
  });
  divider.addEventListener("keydown", (event) => {
    const now = Number(divider.getAttribute("aria-valuenow"));
    const target = { ArrowLeft: now - 2, ArrowRight: now + 2, Home: 0, End: 100 }[event.key];
    if (target === undefined) return;
    event.preventDefault();
    place(target);
  });
  for (const select of strip.querySelectorAll("select")) {
    const show = () => {
      const shown = pair.querySelector(`.${select.dataset.side}`);
      shown.src = pictures[select.value].src;
      shown.alt = pictures[select.value].alt;
    };
    select.addEventListener("change", show);
    show();
  }
  compare.hidden = false;
}
