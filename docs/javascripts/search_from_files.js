// Browsers start no worker for pages opened as files, and the search of the site runs in one: there it gets a hidden frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(address) {
      super();
      const frame = document.createElement("iframe"), waiting = [];
      frame.hidden = true;
      // What the worker says goes to the page above; what it is told arrives as messages of its window.
      frame.srcdoc = `<script>self.postMessage = (data) => parent.postMessage(data, "*");
        self.importScripts = (...all) => Promise.all(all.map((one) => new Promise((done) => {
          document.head.append(Object.assign(document.createElement("script"), { src: one, onload: done }));
        })));<\/script><script src="${address}"><\/script>`;
      this.postMessage = (data) => waiting.push(data);
      frame.addEventListener("load", () => {
        this.postMessage = (data) => window.postMessage.call(frame.contentWindow, data, "*"); // its own is the worker's
        waiting.forEach(this.postMessage);
      });
      window.addEventListener("message", ({ source, data }) => {
        if (source === frame.contentWindow) this.dispatchEvent(new MessageEvent("message", { data }));
      });
      document.body.append(frame);
    }
  };
}
