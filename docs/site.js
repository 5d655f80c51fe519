// Without a font for equations, as on many Linux machines, a browser does not lower indices.
// Then the class "no-math-font" does (site.css).
const probe = document.createElement("div")
probe.innerHTML = "<math><msub><mi>x</mi><mi>x</mi></msub></math>"
document.body.append(probe)
const [base, index] = probe.querySelectorAll("mi")
const below = index.getBoundingClientRect().bottom - base.getBoundingClientRect().bottom
document.documentElement.classList.toggle("no-math-font", below < 0.1 * base.getBoundingClientRect().height)
probe.remove()
