// Time: a slider from the first submap to the newest, which plays by itself.
const STEP_MS = 500;
const LONGEST_MS = 30000; // a long merge takes larger steps

export class Replay {
  constructor(button, slider, onMoment) {
    this.button = button;
    this.slider = slider;
    this.onMoment = onMoment;
    this.timer = null;
    slider.oninput = () => {
      this.#stop();
      onMoment();
    };
    button.onclick = () => (this.timer === null ? this.#play() : this.#stop());
  }

  get moment() {
    return Number(this.slider.value);
  }

  /** So many moments there are now; who is at the newest stays with it. */
  resize(count) {
    const wasNewest = this.slider.value === this.slider.max;
    this.slider.max = String(count);
    if (wasNewest && this.timer === null) this.slider.value = this.slider.max;
  }

  #play() {
    const last = Number(this.slider.max);
    if (this.moment >= last) this.slider.value = "0";
    const step = Math.max(1, Math.ceil((last * STEP_MS) / LONGEST_MS));
    this.#show("❚❚", "Pause");
    this.timer = setInterval(() => {
      this.slider.value = String(Math.min(this.moment + step, Number(this.slider.max)));
      if (this.slider.value === this.slider.max) this.#stop();
      this.onMoment();
    }, STEP_MS);
    this.onMoment();
  }

  #stop() {
    clearInterval(this.timer);
    this.timer = null;
    this.#show("▶", "Play");
  }

  #show(sign, name) {
    this.button.textContent = sign;
    this.button.setAttribute("aria-label", name);
  }
}
