# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Learn the bias of TDOAs from flights with ground truth.

labels     errors of the TDOAs of flights at their true poses; training and validation flights
models     the effects that diagnose finds, and the network of Zhao et al. (RA-L 2021), trained by one call; the share of
           a model that cross-validation over flights supports
"""
