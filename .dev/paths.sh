# Keeps the present folder out of what is started from this shell; for sh, bash and zsh. A folder of recordings may hold anything.
# 1. An entry of a path that does not begin with / begins in the present folder; an empty one is that folder. The last `:` of colcon is such an entry.
for _uwb_name in PATH LD_LIBRARY_PATH PYTHONPATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH PKG_CONFIG_PATH; do
  eval "_uwb_rest=\${$_uwb_name-}:"
  _uwb_kept=
  while [ -n "$_uwb_rest" ]; do
    case $_uwb_rest in /*) _uwb_kept=$_uwb_kept:${_uwb_rest%%:*} ;; esac
    _uwb_rest=${_uwb_rest#*:}
  done
  if [ -n "$_uwb_kept" ]; then export "$_uwb_name=${_uwb_kept#:}"; else unset "$_uwb_name"; fi
done
unset _uwb_name _uwb_rest _uwb_kept
# 2. Fast DDS reads DEFAULT_FASTRTPS_PROFILES.xml of the present folder. Its log then writes to any file of the user.
export SKIP_DEFAULT_XML_FILE=1
