/* Search without a server: a page opened from a folder may not start a Worker, so that the search
   runs in a hidden frame of the page's own origin. Only for file:; elsewhere nothing changes. */
"use strict";
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.onmessage = null;
      this._frame = document.createElement("iframe");
      this._frame.hidden = true;
      document.body.append(this._frame);
      const inside = this._frame.contentWindow;
      inside.document.open();
      inside.document.write("<!doctype html><title>search</title><body></body>");
      inside.postMessage = (data) => {
        const event = new MessageEvent("message", { data });
        this.dispatchEvent(event);
        if (this.onmessage) this.onmessage(event);
      };
      inside.importScripts = (...urls) =>
        urls.reduce((before, one) => before.then(() => load(one)), Promise.resolve());
      const load = (source) =>
        new Promise((resolve, reject) => {
          const script = inside.document.createElement("script");
          script.src = source;
          script.onload = resolve;
          script.onerror = () => reject(new Error(`${source} cannot be loaded`));
          inside.document.body.append(script);
        });
      this._ready = load(url);
      inside.document.close();
    }
    postMessage(data) {
      this._ready.then(() => {
        const inside = this._frame.contentWindow;
        inside.dispatchEvent(new inside.MessageEvent("message", { data }));
      });
    }
    terminate() {
      this._frame.remove();
    }
  };
}
