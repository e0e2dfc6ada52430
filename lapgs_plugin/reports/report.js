// Say where a table has columns beside the window: a phone shows no bar to scroll by.
"use strict";
for (const box of document.querySelectorAll(".scroll")) {
  const update = () => {
    const before = box.scrollLeft, hidden = box.scrollWidth - box.clientWidth - before;
    box.style.setProperty("--hidden", hidden > 1 ? `${hidden}px` : "-2.5rem");  // moves the fading off the table
    if (before + hidden > 1) box.dataset.sign = `${before > 1 ? "\u2190 " : ""}more columns${hidden > 1 ? " \u2192" : ""}`;
    else delete box.dataset.sign;
  };
  box.addEventListener("scroll", update, { passive: true });
  new ResizeObserver(update).observe(box);
}

// Show two pictures of a view on top of each other, with a divider to drag or to move with the arrow keys.
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
