# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
#
# ROS 2 from Python wheels differs from an installed ROS 2 in two ways that stop a rosidl package
# from building. Both cures do nothing where ROS 2 is installed.

# The type supports are looked up in AMENT_PREFIX_PATH, which a setup.bash would have set. Wheels
# bring none: the prefix is then the one in which ament_cmake was found.
macro(ros_from_pip_set_prefix)
  if("$ENV{AMENT_PREFIX_PATH}" STREQUAL "")
    cmake_path(SET _ros_from_pip_prefix NORMALIZE "${ament_cmake_DIR}/../../..")
    set(ENV{AMENT_PREFIX_PATH} "${_ros_from_pip_prefix}")
  endif()
endmacro()

# The exported Python targets name include folders of the machine that built the wheels, and CMake
# refuses a target with an include folder that does not exist.
function(ros_from_pip_drop_missing_includes)
  get_directory_property(targets IMPORTED_TARGETS)
  list(FILTER targets INCLUDE REGEX "__rosidl_generator_py$")
  foreach(target IN LISTS targets)
    get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
    set(existing "")
    foreach(folder IN LISTS folders)
      if(EXISTS "${folder}")
        list(APPEND existing "${folder}")
      endif()
    endforeach()
    set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${existing}")
  endforeach()
endfunction()
