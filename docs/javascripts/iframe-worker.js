// Search in pages that were opened as files, where browsers allow no Worker: one that runs in a hidden frame.
(() => {
  function load(frame, url) {
    return new Promise((resolve, reject) => {
      const script = frame.document.createElement("script");
      script.src = url;
      script.onload = resolve;
      script.onerror = () => reject(new Error(`cannot load ${url}`));
      frame.document.head.append(script);
    });
  }

  class FrameWorker extends EventTarget {
    constructor(url) {
      super();
      const element = document.createElement("iframe");
      element.hidden = true;
      document.body.append(element);
      const frame = element.contentWindow;
      // The search's own script sends its answers by postMessage(data), as a worker does.
      frame.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      frame.importScripts = (...urls) =>
        urls.reduce((done, each) => done.then(() => load(frame, each)), Promise.resolve());
      this.frame = frame;
      this.loaded = load(frame, url);
    }

    postMessage(data) {
      const deliver = () => this.frame.dispatchEvent(new this.frame.MessageEvent("message", { data }));
      this.loaded.then(deliver, (error) => console.error(error));
    }

    terminate() {
      this.frame.frameElement.remove();
    }
  }

  if (location.protocol === "file:") window.Worker = FrameWorker;
})();
