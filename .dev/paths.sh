# Keeps the present folder out of what is started from this shell; for sh, bash and zsh. A folder of recordings may hold anything.
# 1. An empty entry of a path, as a dot, is the present folder to the loader, the shell and Python. The last `:` of colcon is such an entry.
for _uwb_name in PATH LD_LIBRARY_PATH PYTHONPATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH PKG_CONFIG_PATH; do
  eval "_uwb_value=:\${$_uwb_name-}:"
  while case $_uwb_value in *::*) ;; *) false ;; esac; do _uwb_value=${_uwb_value%%::*}:${_uwb_value#*::}; done
  while case $_uwb_value in *:.:*) ;; *) false ;; esac; do _uwb_value=${_uwb_value%%:.:*}:${_uwb_value#*:.:}; done
  _uwb_value=${_uwb_value#:}
  _uwb_value=${_uwb_value%:}
  if [ -n "$_uwb_value" ]; then export "$_uwb_name=$_uwb_value"; else unset "$_uwb_name"; fi
done
unset _uwb_name _uwb_value
# 2. Fast DDS reads DEFAULT_FASTRTPS_PROFILES.xml of the present folder. Its log then writes to any file of the user.
export SKIP_DEFAULT_XML_FILE=1
