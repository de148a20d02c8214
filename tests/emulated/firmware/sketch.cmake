# SPDX-License-Identifier: MIT
# The Arduino sketch as a second program of deploy/bridge/pico, on a stand-in for the Arduino core
# that runs on the real pico-sdk:
#   -DCMAKE_PROJECT_graspd_bridge_INCLUDE=.../sketch.cmake
function(add_sketch)
  set(folder "${CMAKE_CURRENT_FUNCTION_LIST_DIR}/arduino")
  set(sketch "${bridge}/rp2040/graspd_bridge/graspd_bridge.ino")
  set_source_files_properties("${folder}/core.cpp" PROPERTIES OBJECT_DEPENDS "${sketch}")
  bridge_program(sketch "${folder}/core.cpp")
  target_include_directories(sketch PRIVATE "${folder}")
  target_compile_definitions(sketch PRIVATE SKETCH="${sketch}")
endfunction()

cmake_language(DEFER CALL add_sketch) # once everything else is there
