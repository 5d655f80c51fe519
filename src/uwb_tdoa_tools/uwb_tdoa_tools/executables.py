# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Entry points that setup.py names: one for each file in commands/."""

from uwb_tdoa_bias.common.executable import executable, node_executable

autopilot_node = node_executable("uwb_tdoa_tools.autopilot_node")
calibrate = executable("uwb_tdoa_tools.commands.calibrate")
check = executable("uwb_tdoa_tools.commands.check")
convert = executable("uwb_tdoa_tools.commands.convert")
debias = executable("uwb_tdoa_tools.commands.debias")
demo = executable("uwb_tdoa_tools.commands.demo")
diagnose = executable("uwb_tdoa_tools.commands.diagnose")
evaluate = executable("uwb_tdoa_tools.commands.evaluate")
export = executable("uwb_tdoa_tools.commands.export")
fly = executable("uwb_tdoa_tools.commands.fly")
inject = executable("uwb_tdoa_tools.commands.inject")
localize = executable("uwb_tdoa_tools.commands.localize")
map_anchors = executable("uwb_tdoa_tools.commands.map_anchors")
plan = executable("uwb_tdoa_tools.commands.plan")
replay = executable("uwb_tdoa_tools.commands.replay")
simulate = executable("uwb_tdoa_tools.commands.simulate")
survey = executable("uwb_tdoa_tools.commands.survey")
train = executable("uwb_tdoa_tools.commands.train")
vehicle_node = node_executable("uwb_tdoa_tools.vehicle_node")
