"use strict";
(() => {
  // Dropped or chosen files are sent as they are, one after the other. The answer names the page of a recording.
  const drop = document.querySelector(".drop");
  const send = (file, bar) => new Promise((arrived, refused) => {
    if (file.size > Number(drop.dataset.most)) {
      refused(`${file.name}: this file is too large`);
      return;
    }
    const request = new XMLHttpRequest();
    request.open("POST", `${drop.dataset.to}?name=${encodeURIComponent(file.name)}`);
    request.responseType = "json";
    request.upload.addEventListener("progress", (event) => { bar.value = event.loaded / event.total; });
    request.addEventListener("load", () => {
      if (request.status === 200) arrived(request.response.at);
      else refused(request.response?.error ?? "The file could not be sent.");
    });
    request.addEventListener("error", () => refused("The file could not be sent. Does `bayeskin app` still run?"));
    request.send(file);
  });
  const sendAll = async (files) => {
    const bar = drop.querySelector("progress");
    const problem = drop.querySelector(".problem");
    problem.hidden = true;
    bar.hidden = false;
    let at = "";
    try {
      for (const file of files) at = await send(file, bar);
      location.assign(files.length === 1 ? at : location.href);
    } catch (line) {
      bar.hidden = true;
      problem.textContent = line;
      problem.hidden = false;
    }
  };
  if (drop) {
    for (const name of ["dragover", "dragleave", "drop"]) {
      addEventListener(name, (event) => {
        event.preventDefault();
        drop.classList.toggle("over", name === "dragover");
        if (name === "drop" && event.dataTransfer.files.length) sendAll([...event.dataTransfer.files]);
      });
    }
    const chosen = drop.querySelector("input");
    chosen.addEventListener("change", () => sendAll([...chosen.files]));
  }

  // The page of a job that runs is fetched again every second, and its changing parts are taken over.
  const job = document.getElementById("job");
  const look = async () => {
    try {
      const answer = await fetch(location.href);
      const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
      const now = fresh.getElementById("job");
      if (!answer.ok || !now) throw new Error("no job");
      if (now.dataset.state !== job.dataset.state) {
        location.reload();
        return;
      }
      document.getElementById("now").replaceWith(fresh.getElementById("now"));
      const lines = document.getElementById("lines");
      const said = fresh.getElementById("lines").textContent;
      if (lines.textContent !== said) {
        lines.textContent = said;
        lines.scrollTop = lines.scrollHeight;
      }
    } catch { /* the program of the page may be about to start again */ }
    setTimeout(look, 1000);
  };
  if (job && job.dataset.state === "running") setTimeout(look, 1000);
})();
