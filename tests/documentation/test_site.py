"""Every page of the documentation site, opened in a browser: links, images, scripts, width, and the search.

Skipped where the site cannot be built or no browser is installed.
"""

import re
from urllib.parse import unquote, urldefrag

import pytest

import openmm_sier

#: The first of them waits until the site is built.
pytestmark = pytest.mark.timeout(2000)

#: Widths of a window in px.
WIDE, NARROW = 1280, 375

#: Waits until all images are there, those included that a page loads when they are scrolled to.
IMAGES_LOADED = """
const done = arguments[0], images = [...document.images];
for (const image of images) image.loading = 'eager';
Promise.allSettled(images.map(image => image.decode())).then(() =>
    done(images.filter(image => !image.naturalWidth).map(image => image.src)));
"""

#: Elements that stick out of the window, the least wide first, where the page or its text has to be scrolled sideways.
#: Tables and listings that scroll by themselves are right.
TOO_WIDE = """
const frames = document.querySelectorAll('html, body, .page, .main, .content'), width = window.innerWidth;
if ([...frames].every(frame => frame.scrollWidth <= frame.clientWidth + 1)) return [];
return [...document.querySelectorAll('article *')].filter(e => e.getBoundingClientRect().right > width + 1)
    .sort((a, b) => a.getBoundingClientRect().right - b.getBoundingClientRect().right).slice(0, 3)
    .map(e => e.outerHTML.slice(0, 120));
"""

#: Questions from the trackers of OpenMM and of packages around it, what one would type, and the page that answers.
QUESTIONS = [
    ("openmm 749: Question about integration accuracy: tip3p density", "tip3p density step", "guide/howto/density"),
    ("openmm 2204: Best integrators to NVE run", "best integrators NVE", "guide/howto/constant-energy"),
    ("openmm 927: Constraint Tolerance Guidelines", "constraint tolerance", "guide/engines"),
    ("openmm 3689: Inconsistent temperature with Verlet", "temperature drops NVT NVE", "guide/howto/constant-energy"),
    ("openmm 1604: rigid body simulation", "rigid body simulation", "guide/howto/rigid-molecules"),
    ("openmm 4509: How can I perform rigidbody simulation?", "rigid clusters gas phase", "guide/howto/rigid-molecules"),
    ("openmm 3993: rigid body and Nose-Hoover: weird distribution", "rigid thermostat", "guide/howto/rigid-molecules"),
    ("openff-evaluator 587: temperature below the bath's", "average temperature below bath", "guide/howto/density"),
    ("openmmtools 22: GHMC is slow", "GHMC slower", "guide/howto/exact-averages"),
    ("timemachine 787: HMC of a solvated protein", "acceptance solvated protein", "guide/howto/exact-averages"),
    ("openmm 2202: Best practices for checkpointing", "determinism checkpoint", "guide/restarts"),
    ("openmm 2634: Reported temperature for MD with constraints", "degrees of freedom", "guide/howto/density"),
    ("alchemical free energies", "alchemical free energies", "guide/howto/enhanced-sampling"),
    ("replica exchange with solute scaling", "REST2", "guide/howto/enhanced-sampling"),
    ("implicit solvent", "implicit solvent", "guide/howto/solutes"),
    ("a molecule in vacuum", "vacuum", "guide/howto/solutes"),
    ("hydrogen mass repartitioning", "heavy hydrogens", "guide/howto/heat-bath"),
    ("metadynamics", "metadynamics", "guide/howto/enhanced-sampling"),
    ("simulated tempering", "simulated tempering", "guide/howto/enhanced-sampling"),
    ("the same by the name of OpenMM's class", "SimulatedTempering", "guide/howto/enhanced-sampling"),
    ("replica exchange", "replica exchange", "guide/howto/enhanced-sampling"),
    ("a rigid protein", "rigid protein", "guide/howto/large-bodies"),
    ("CALVADOS with rigid domains", "CALVADOS rigid domains", "guide/howto/rigid-domains"),
    ("crowding", "crowd of proteins", "guide/howto/large-bodies"),
    ("openmmtools refuses a heat bath", "heat bath at a different temperature", "guide/howto/enhanced-sampling"),
    ("velocity autocorrelation", "velocity correlations", "guide/howto/constant-energy"),
    ("dipole autocorrelation", "dipole correlation", "guide/howto/constant-energy"),
    ("openmm 3955: accuracy of PME at the default tolerance", "PME default tolerance", "measurements/accuracy"),
    ("many runs with other seeds", "many runs seeds", "guide/command"),
]


@pytest.fixture(scope="session")
def pages(site):
    """Paths of all pages within the site."""
    results = sorted(path.relative_to(site).as_posix() for path in site.rglob("*.html"))
    assert {"index.html", "search.html", "guide/howto/index.html", "api/index.html"} <= set(results)
    return results


def resize(browser, width):
    """A window narrower than Chromium makes one is emulated."""
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width == NARROW},
    )


@pytest.mark.thorough
def test_every_page_in_a_browser(browser, address, pages):
    """No image is missing, no script fails or comes from elsewhere, no link is broken, nothing sticks out at 375 px."""
    faults, links, names = [], {}, {}
    for page in pages:
        resize(browser, WIDE)
        browser.get(address + page)
        missing = browser.execute_async_script(IMAGES_LOADED)
        faults += [f"{page}: the image {image} is missing" for image in missing]
        faults += [f"{page}: {entry['message']}" for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
        loaded = browser.execute_script("return performance.getEntriesByType('resource').map(entry => entry.name)")
        faults += [f"{page} loads {url}" for url in loaded if not url.startswith((address, "data:"))]
        names[page] = set(browser.execute_script("return [...document.querySelectorAll('[id]')].map(e => e.id)"))
        links[page] = browser.execute_script("return [...document.querySelectorAll('a[href]')].map(a => a.href)")
        resize(browser, NARROW)
        faults += [f"{page} is too wide for {NARROW} px: {what}" for what in browser.execute_script(TOO_WIDE)]
    for page, targets in links.items():
        for target in set(targets):
            if target.startswith(address):
                path, name = urldefrag(target[len(address) :])
                path = path.split("?")[0] or "index.html"
                known = path in names or (name == "" and path.startswith(("_sources/", "_downloads/", "_images/")))
                if not known or (name and unquote(name) not in names[path]):
                    faults.append(f"{page}: nothing is at {target}")
            elif not target.startswith("https://"):
                faults.append(f"{page} links to {target}")
    assert not faults, "\n".join(faults)


@pytest.mark.thorough
def test_questions_are_answered_by_a_page_that_the_search_finds(browser, address):
    """The page is among the first three results of the site's own search."""
    from selenium.webdriver.support.ui import WebDriverWait

    wrong = []
    for question, words, page in QUESTIONS:
        browser.get(f"{address}search.html?q={words.replace(' ', '+')}")
        WebDriverWait(browser, 300).until(
            lambda driver: re.search(
                "found|did not match", driver.find_element("css selector", "#search-results p").text
            )
        )
        results = browser.execute_script(
            "return [...document.querySelectorAll('#search-results li > a')].map(a => new URL(a.href).pathname)"
        )
        first = list(dict.fromkeys(result.strip("/").removesuffix(".html") for result in results))[:3]
        if page not in first:
            wrong.append(f"{question}: '{words}' gives {first}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.thorough
def test_every_public_name_is_in_the_reference(site):
    text = "".join(path.read_text() for path in (site / "api").glob("*.html"))
    names = [name for name in openmm_sier.__all__ if name != "__version__"]
    assert [name for name in names if f'id="openmm_sier.{name}"' not in text] == []
