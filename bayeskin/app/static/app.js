"use strict";
(() => {
  // A dropped or chosen file is sent as it is; the answer names the page of the new recording.
  const drop = document.querySelector(".drop");
  const send = (file) => {
    const bar = drop.querySelector("progress");
    const problem = drop.querySelector(".problem");
    const fail = (text) => {
      bar.hidden = true;
      problem.textContent = text;
      problem.hidden = false;
    };
    if (file.size > Number(drop.dataset.most)) {
      fail(`${file.name}: this file is too large`);
      return;
    }
    problem.hidden = true;
    bar.hidden = false;
    const request = new XMLHttpRequest();
    request.open("POST", `${drop.dataset.to}?name=${encodeURIComponent(file.name)}`);
    request.responseType = "json";
    request.upload.addEventListener("progress", (event) => { bar.value = event.loaded / event.total; });
    request.addEventListener("load", () => {
      if (request.status === 200) location.assign(request.response.at);
      else fail(request.response?.error ?? "The file could not be sent.");
    });
    request.addEventListener("error", () => fail("The file could not be sent. Does `bayeskin app` still run?"));
    request.send(file);
  };
  if (drop) {
    for (const name of ["dragover", "dragleave", "drop"]) {
      addEventListener(name, (event) => {
        event.preventDefault();
        drop.classList.toggle("over", name === "dragover");
        if (name === "drop" && event.dataTransfer.files.length) send(event.dataTransfer.files[0]);
      });
    }
    drop.querySelector("input").addEventListener("change", (event) => send(event.target.files[0]));
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
