r"""
What a certificate rests on
===========================

A certificate states results with expanded uncertainties, and what they rest on. Every contribution is kept
apart until the end, so that a reader sees what would have to be improved: more photographs, a better
target, or a thermometer.
"""

# %%
# A calibration whose scale rests on a certified target, at a temperature that is known to 0.5 K.
import json
from datetime import date

import matplotlib.pyplot as plt
import numpy as np

import reseau
from reseau.bundle import calibration_of, example_network
from reseau.service.certificates import CertificateData, certify, html_of

calibration = calibration_of(
    reseau.adjust_network(example_network(noise_px=0.01)).required(), "camera", name="camera 17"
)
laboratory = {"name": "Institute of Photogrammetry", "city": "Bonn", "country": "DE"}
data = CertificateData.parse(json.dumps(
    {
        "schema": "reseau-certificate-data/1",
        "laboratory": laboratory,
        "customer": laboratory,
        "responsible": ["A. Byron"],
            "begin": "2026-03-02",
            "end": "2026-03-02",
        "item": {"name": "camera", "serial": "4711"},
        "standards": [{"name": "board 3", "kind": "target", "identification": "T-3",
                       "certificate": {"issuer": "PTB", "id": "5.4-1234"}}],
        "temperature": {"celsius": 20.4, "sigma": 0.5, "coefficients": {"c": 2e-3}},
        "contributions": [{"name": "scale of the target", "kind": "target coordinates", "sigma": 2e-4,
                           "sensitivities": {"c": 8.0}, "distribution": "rectangular"}],
    }
), where="data.json")  # fmt: skip
made = certify(calibration, data, issued=date(2026, 3, 3))
print(made.parameters)
print(*made.traceability, sep="\n")
for source, why in made.uncertainty.missing.items():
    print(f"not included: {source}: {why}")

# %%
# The budget of every parameter, as shares of its variance.
budget = made.parameters
share = np.square(budget.by_contribution) / np.square(budget.sigma)
figure, axes = plt.subplots(figsize=(7.4, 3.2), layout="constrained")
left = np.zeros(len(budget.names))
for each, part, colour in zip(
    budget.contributions, share, ("#2f5d7c", "#b3402a", "#9aa3a8", "#6f9a3a"), strict=False
):
    axes.barh(budget.names, part, left=left, color=colour, label=each.name, height=0.6)
    left += part
axes.set(xlim=(0, 1), xlabel="share of the variance")
axes.legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
axes.invert_yaxis()
assert np.allclose(share.sum(axis=0), 1.0)

# %%
# The page a reader gets; ``pdf_of`` makes a PDF/A of it with the data inside, ``dcc_of`` a digital
# calibration certificate in XML.
page = html_of(made)
print(len(page), "characters;", made.identifier)
assert "T-3" in page
