# Only for builds against the ROS wheels (CMAKE_PROJECT_INCLUDE in pyproject.toml): a build against
# an installed ROS 2 never reads this file.

# 1. The wheels put their files under the prefix that they are installed into: a virtual environment
#    or pip's isolated build overlay. One of them tells which.
if(DEFINED Python3_EXECUTABLE)
  execute_process(
    COMMAND "${Python3_EXECUTABLE}" -c
      "import ament_package, pathlib; print(pathlib.Path(ament_package.__file__).resolve().parents[4])"
    OUTPUT_VARIABLE _rosrm_prefix OUTPUT_STRIP_TRAILING_WHITESPACE COMMAND_ERROR_IS_FATAL ANY)
  list(PREPEND CMAKE_PREFIX_PATH "${_rosrm_prefix}")
  set(ENV{AMENT_PREFIX_PATH} "${_rosrm_prefix}")
  message(STATUS "ROS wheels: ${_rosrm_prefix}")
endif()

# 2. rclpy and its middleware use the C type supports alone: generate nothing for C++, which is half of
#    the files. (Fast DDS needs the introspection too: it registers each type by it.)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp")
set(STATIC_ROSIDL_TYPESUPPORT_C rosidl_typesupport_fastrtps_c rosidl_typesupport_introspection_c)

# 3. Their exported targets carry an include path of the machine that they were built on, and CMake
#    refuses an imported target with an include folder that is missing: drop those, after all
#    find_package() calls.
function(_rosrm_drop_missing_includes)
  get_property(_targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(_target IN LISTS _targets)
    get_target_property(_includes ${_target} INTERFACE_INCLUDE_DIRECTORIES)
    if(_includes)
      set(_kept "")
      foreach(_include IN LISTS _includes)
        if(_include MATCHES "\\$<" OR EXISTS "${_include}")
          list(APPEND _kept "${_include}")
        endif()
      endforeach()
      set_target_properties(${_target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${_kept}")
    endif()
  endforeach()
endfunction()

# 4. Some three hundred small generated files, most of whose compile time goes into the same headers:
#    compile them in batches, or where files specialise templates after use, with precompiled headers
#    (together 40 % less CPU time). rosidl_generator_c bears neither: its files repeat file-local names.
function(_rosrm_compile_faster)
  foreach(_part IN ITEMS fastrtps_c introspection_c c)
    set(_target ${PROJECT_NAME}__rosidl_typesupport_${_part})
    if(TARGET ${_target})
      set_target_properties(${_target} PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 20)
    endif()
  endforeach()
endfunction()

cmake_language(DEFER CALL _rosrm_drop_missing_includes)
cmake_language(DEFER CALL _rosrm_compile_faster)
